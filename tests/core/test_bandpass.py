"""The filter on signals whose phase is known."""

from __future__ import annotations

import numpy as np
import pytest

from endo3d_core.bandpass import filter_row, gabor


def filtered(signal: np.ndarray, period: float) -> np.ndarray:
    g = gabor(period)
    real, imag = np.empty((2, signal.size), np.float32)
    filter_row(np.pad(signal.astype(np.float32), g.taps), g.cosine, g.sine, real, imag)
    return real + 1j * imag


@pytest.mark.parametrize("period", [6.0, 13.1, 26.0, 52.3])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_cosine_becomes_its_phasor(period: float, sign: float) -> None:
    """Exact at the carrier, for phases that grow along the row and for phases that fall."""
    phase = sign * (2 * np.pi * np.arange(400) / period + 0.4)
    inner = slice(60, -60)
    np.testing.assert_allclose(filtered(np.cos(phase), sign * period)[inner], np.exp(1j * phase)[inner], atol=2e-6)


def test_a_slow_background_hardly_passes() -> None:
    """A linear ramp of one fringe amplitude over a period leaks under 0.2 of it."""
    ramp = np.arange(400) / 13.0
    assert np.abs(np.diff(filtered(ramp, 13.0)[60:-60])).max() < 0.1


def test_noise_gain_is_what_white_noise_shows() -> None:
    out = filtered(np.random.default_rng(5).normal(size=200_000), 13.0)
    np.testing.assert_allclose(np.sqrt(0.5 * np.var(out)), gabor(13.0).noise_gain, rtol=0.02)


def test_too_fine_fringes_are_refused() -> None:
    with pytest.raises(ValueError, match="too short"):
        gabor(2.5)
