"""The sensor's noise against the photon-transfer law."""

from __future__ import annotations

import numpy as np
import pytest

from endo3d_core.virtual_rig.sensor import Sensor, develop


def shots(mean_e: float, sensor: Sensor, count: int = 100) -> np.ndarray:
    """(count, 128, 128) grey values of an even light."""
    images = np.zeros((count, 128, 128), sensor.dtype)
    where = np.arange(128 * 128, dtype=np.uint32)
    light = np.full(where.size, mean_e, np.float32)
    for k in range(count):
        develop(sensor, light, where, number=k, noise=True, out=images[k])
    return images


@pytest.mark.parametrize("mean_e", [0.0, 300.0, 1_000.0, 5_000.0, 16_000.0, 28_000.0])
def test_variance_follows_the_photon_transfer_law(mean_e: float) -> None:
    """EMVA 1288: variance = (mean + read noise^2) / K^2 + quantisation's 1/12, over time and over pixels."""
    sensor = Sensor(bits=12)
    grey = shots(mean_e, sensor).astype(np.float64)
    K = sensor.electrons_per_grey
    if mean_e > 0.0:  # at 0 half of the read noise is clipped away
        law = (mean_e + sensor.read_noise_e**2) / K**2 + 1 / 12
        assert grey.mean() == pytest.approx(mean_e / K, abs=4 * np.sqrt(law / grey.size))
        assert grey.var(axis=0, ddof=1).mean() == pytest.approx(law, rel=0.01)
        assert grey.var(axis=(1, 2), ddof=1).mean() == pytest.approx(law, rel=0.01)
    else:
        assert grey.mean() < 1.0


def test_noise_is_white_and_never_repeats() -> None:
    grey = shots(8_000.0, Sensor(bits=12), 20).astype(np.float64)
    grey -= grey.mean()
    n = grey[0].size
    sigma = 1 / np.sqrt(n)
    z = (grey / grey.std()).reshape(20, -1)
    assert abs(np.corrcoef(z)[np.triu_indices(20, 1)]).max() < 5 * sigma
    flat = z[0].reshape(128, 128)
    assert abs((flat[:, 1:] * flat[:, :-1]).mean()) < 5 * sigma
    assert abs((flat[1:] * flat[:-1]).mean()) < 5 * sigma


def test_bright_light_saturates_at_the_full_well() -> None:
    grey = shots(40_000.0, Sensor(bits=8), 2)
    assert (grey == 255).all()


def test_noise_is_normal_out_to_four_sigma() -> None:
    grey = shots(20_000.0, Sensor(bits=12), 60).astype(np.float64)
    z = ((grey - grey.mean()) / grey.std()).ravel()
    assert abs((z**3).mean()) < 0.02
    assert (z**4).mean() == pytest.approx(3.0, abs=0.05)
    assert 1e-5 < (np.abs(z) > 4).mean() < 1.5e-4
