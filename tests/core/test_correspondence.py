"""Projector coordinates: exact on exact fringes, with the noise that theory gives, sampled across a print."""

import math

import numpy as np
import pytest
from scipy.spatial import cKDTree

from endo3d_core import patterns
from endo3d_core.calibrating.correspondence import ProjectorMap, projector_map, sample

N = 960
HEIGHT, WIDTH = 60, 80


def truth() -> np.ndarray:
    """A smooth (height, width) field of projector coordinates over nearly the whole projector."""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    return 20.0 + 11.3 * u + 0.4 * v + 0.002 * u * v


def fringes(
    pattern_set: patterns.PatternSet, x: np.ndarray, albedo: np.ndarray | float, noise: float = 0.0
) -> np.ndarray:
    rng = np.random.default_rng(5)
    clean = np.stack([albedo * (20 + 180 * patterns.profile(p, x, N)) for p in pattern_set.patterns])
    return (clean + rng.normal(0, noise, clean.shape)).astype(np.float32)


@pytest.mark.parametrize(
    "text",
    [
        "conventional f=50/49/43 steps=4/2/2",
        "sequence f=8/8/8/7/7/7 shifts=-2.0944/0/2.0944/-2.0944/0/2.0944",
        "sequence f=7/7/7/8/8/8 shifts=-2.0944/0/2.0944/-2.0944/0/2.0944",
        "sequence f=1/1/1 shifts=0/2/4",
    ],
)
def test_exact_fringes_give_the_exact_coordinate(text: str) -> None:
    pattern_set = patterns.parse(text)
    found = projector_map(fringes(pattern_set, truth(), 0.7), pattern_set.patterns, N)
    np.testing.assert_allclose(found.coordinate_px, truth(), atol=2e-3)
    np.testing.assert_allclose(found.white, 0.7 * 110, rtol=1e-4)
    np.testing.assert_allclose(found.contrast, 90 / 110, rtol=1e-4)


def test_noise_is_that_of_the_phase_shift() -> None:
    pattern_set = patterns.parse("conventional f=50/49/43 steps=4/2/2")
    noise = 2.0
    found = projector_map(fringes(pattern_set, truth(), 1.0, noise), pattern_set.patterns, N)
    phase_noise = noise / 90 * math.sqrt(2 / 4)  # n-step: sigma sqrt(2 / n) / b
    expected = phase_noise / (2 * math.pi * 50) * N
    assert np.std(found.coordinate_px - truth()) == pytest.approx(expected, rel=0.1)


def test_repeating_patterns_are_refused() -> None:
    pattern_set = patterns.parse("sequence f=28.8/28.8/28.8/19.2/19.2/19.2 shifts=-2/0/2/-2/0/2")
    with pytest.raises(ValueError, match=r"repeat 9\.6 times"):
        projector_map(fringes(pattern_set, truth(), 1.0), pattern_set.patterns, N)


def test_saturated_and_dark_pixels_are_nan() -> None:
    pattern_set = patterns.parse("conventional f=50/49/43 steps=4/2/2")
    frames = fringes(pattern_set, truth(), 1.0)
    frames[2, 10, 10] = 255
    frames[:, 20, 20] = 7.0
    found = projector_map(frames, pattern_set.patterns, N, saturation=250)
    assert np.isnan(found.coordinate_px[10, 10])
    assert np.isnan(found.coordinate_px[20, 20])
    assert np.isfinite(found.coordinate_px).sum() == HEIGHT * WIDTH - 2


def test_a_feature_on_a_printed_edge_is_sampled_from_both_sides() -> None:
    pattern_set = patterns.parse("conventional f=50/49/43 steps=4/2/2")
    x = truth()
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    print_ = np.where((u < 40.3) == (v < 30.6), 1.0, 0.08)
    found = projector_map(
        fringes(pattern_set, x, print_, noise=1.0), pattern_set.patterns, N, contrast_min=0.05
    )
    wild = found.coordinate_px.copy()
    wild[28, 41] += 500
    dirty = ProjectorMap(wild, found.contrast, found.modulation, found.white)
    at = np.array([[40.3, 30.6], [1000.0, 10.0]])
    points = np.stack((u.ravel(), v.ravel()), axis=-1).astype(np.float64)
    sampled = sample(points, cKDTree(points), dirty, found, at, 8.0)
    expected = 20.0 + 11.3 * 40.3 + 0.4 * 30.6 + 0.002 * 40.3 * 30.6
    np.testing.assert_allclose(sampled[0], expected, atol=0.03)
    assert np.all(np.isnan(sampled[1]))
