"""The conventional mode on planes, and its algebra."""

from __future__ import annotations

import numpy as np
import pytest
from planes import Plane, field, render, small_rig

from endo3d_core import patterns, triangulation
from endo3d_core.conventional import Conventional
from endo3d_core.demodulation import demodulation, phase_weights, unwrapping_chain


def decode(text: str, *, grey: float = 180.0, exposures: tuple[float, ...] = (1.0,), seed: int = 1):  # type: ignore[no-untyped-def]
    pattern_set = patterns.parse(text)
    rig, rng = small_rig(), np.random.default_rng(seed)
    decoder = Conventional(pattern_set, triangulation.build(rig, 2, 16.5, 23.5), 2)
    per_exposure = len(pattern_set) // len(exposures)
    for k in range(len(pattern_set)):
        light = grey * exposures[k // per_exposure]
        ready = decoder.push(render(rig, pattern_set[k], Plane(), grey=light, rng=rng), k)
        assert ready == (k == len(pattern_set) - 1)
    points = np.empty((300, 480, 6), np.float32)
    decoder.points(points)
    truth = Plane().depth(rig.camera.ray(triangulation.grid_pixels(rig, 2, "columns")))
    inside = field(rig, 2)
    return (points[..., 2] - truth)[inside], points[inside]


@pytest.mark.parametrize(
    "text",
    [
        "conventional f=50/49/43 steps=4/2/2",
        "conventional f=50/49/43 steps=3/2/2",
        "conventional f=50/49/43 steps=8/4/4",
        "conventional f=25/24 steps=4/2",
        "sequence f=50/50/50/49/49/43/43 shifts=0.3/2.0/4.5/0.1/1.9/0/1.2",
    ],
)
def test_every_pixel_of_a_plane_has_the_right_order(text: str) -> None:
    error, _ = decode(text)
    assert np.isfinite(error).all()
    assert np.abs(error).max() < 8e-3


def test_sigma_is_honest() -> None:
    error, points = decode("conventional f=50/49/43 steps=4/2/2")
    assert 0.9 < np.std(error / points[:, 5]) < 1.1


def test_all_frequencies_together_beat_the_finest_alone() -> None:
    together, _ = decode("conventional f=50/49/43 steps=4/4/4")
    weights = demodulation(patterns.parse("conventional f=50/49/43 steps=4/4/4").patterns, (50.0, 49.0, 43.0))
    share = phase_weights(weights, (50.0, 49.0, 43.0))
    alone, _ = decode("conventional f=50/1 steps=4/4")
    assert share.sum() == pytest.approx(1.0)
    assert np.std(together) < 0.7 * np.std(alone)


def test_demodulation_recovers_any_background_and_phases() -> None:
    pattern_set = patterns.parse("conventional f=50/49/43 steps=4/2/2")
    a, b, phases = 100.0, 60.0, {50.0: 0.7, 49.0: -2.1, 43.0: 3.0}
    grey = np.array([a + b * np.cos(phases[p.frequency] + p.shift_rad) for p in pattern_set.patterns])
    out = demodulation(pattern_set.patterns, (50.0, 49.0, 43.0)) @ grey
    expected = [a] + [b * part(phi) for phi in phases.values() for part in (np.cos, np.sin)]
    np.testing.assert_allclose(out, expected, atol=1e-10)


def test_shifts_that_tell_nothing_are_refused() -> None:
    with pytest.raises(ValueError, match="can't tell"):
        demodulation(patterns.parse("sequence f=50/50/50 shifts=0/0/1").patterns, (50.0,))


def test_the_chain_goes_from_the_widest_beat_to_the_finest() -> None:
    assert unwrapping_chain((50.0, 43.0, 49.0)) == [(2, 1.0), (1, 7.0)]


def test_several_exposures_measure_what_one_cannot() -> None:
    """At a twentieth of the light one exposure is blind or noisy; the fused set is as good as the
    brightest allows."""
    text = "conventional f=50/49/43 steps=4/2/2"
    fused, _ = decode(text + " exposures_us=100/1600", grey=30.0, exposures=(1.0, 16.0))
    single, _ = decode(text, grey=30.0)
    assert np.isfinite(fused).all()
    saturated, _ = decode(text, grey=480.0)
    assert np.isnan(saturated).mean() > 0.9
    assert np.std(fused) < 1.05 * np.std(single)
    dim, _ = decode(text + " exposures_us=100/1600", grey=12.0, exposures=(1.0, 16.0))
    assert np.std(dim) < 0.4 * np.std(decode(text, grey=12.0)[0])


def test_a_sequence_that_starts_in_the_middle_waits_for_slot_0() -> None:
    pattern_set = patterns.parse("conventional f=50/49/43 steps=4/2/2")
    decoder = Conventional(pattern_set, triangulation.build(small_rig(4), 2, 16.5, 23.5), 2)
    image = np.zeros((300, 480), np.uint8)
    assert [decoder.push(image, k % 8) for k in range(5, 16)].index(True) == 10
