"""The response is found from the images themselves, and its ripple goes: made-up ones, and real ones."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from endo3d_core.calibrating.correspondence import projector_map
from endo3d_core.patterns import Pattern
from endo3d_core.response import measure, normalised

SHIFTS = (-2 * np.pi / 3, 0.0, 2 * np.pi / 3)
REAL = Path(__file__).parents[2].parent / "shared" / "data" / "kamino_dualfreq" / "object1"


def wrapped(samples: np.ndarray) -> np.ndarray:
    cosine = sum(np.cos(s) * g for s, g in zip(SHIFTS, samples, strict=True))
    sine = -sum(np.sin(s) * g for s, g in zip(SHIFTS, samples, strict=True))
    return np.arctan2(sine, cosine)


@pytest.mark.parametrize("gamma", [0.6, 1.0, 2.2])
def test_a_power_law_is_found_and_removed(gamma: float) -> None:
    rng = np.random.default_rng(1)
    phase = rng.uniform(-np.pi, np.pi, 20_000)
    light = np.stack([0.5 + 0.5 * np.cos(phase + s) for s in SHIFTS])
    grey = light**gamma + rng.normal(0, 0.004, light.shape)
    response = measure(grey)
    assert response.gamma == pytest.approx(gamma, rel=0.03)
    error = np.angle(np.exp(1j * (wrapped(response.linear(grey)) - phase)))
    noise = 0.004 * np.sqrt(2 / 3) / 0.5
    before = np.angle(np.exp(1j * (wrapped(grey) - phase)))
    assert np.std(error) < 4 * noise  # noise grows where the response is flat
    if gamma != 1.0:
        assert np.std(error) < np.std(before) / 8
        assert response.residual < response.residual_before / 5


def test_a_linear_response_is_left_alone() -> None:
    rng = np.random.default_rng(2)
    phase = rng.uniform(-np.pi, np.pi, 20_000)
    grey = np.stack([0.5 + 0.5 * np.cos(phase + s) for s in SHIFTS])
    np.testing.assert_allclose(measure(grey).linear(grey), grey, atol=5e-3)


def test_what_shows_no_response_is_refused() -> None:
    with pytest.raises(ValueError, match="three evenly spaced"):
        measure(np.ones((2, 5000)))
    with pytest.raises(ValueError, match="brighter"):
        measure(np.full((3, 5000), 0.4))


def test_without_contrast_there_is_no_sample() -> None:
    frames = np.full((3, 2, 2), 60, np.uint8)
    white = np.array([[100, 100], [100, 20]], np.uint8)
    found = normalised(frames, white, np.full((2, 2), 20, np.uint8))
    assert np.isnan(found[:, 1, 1]).all()
    np.testing.assert_allclose(found[:, 0, 0], 0.5)


@pytest.fixture(scope="module")
def real() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frames (6, height, width), white, black of a sponge before a wall, two frequencies in three steps."""
    if not REAL.is_dir():
        pytest.skip(f"the real two-frequency captures are not at {REAL}")
    read = [cv2.imread(str(REAL / f"pat{k:02d}.png"), cv2.IMREAD_GRAYSCALE) for k in (*range(6), 30, 31)]
    return np.stack(read[:6]), read[6], read[7]


WALL = (slice(40, 350), slice(400, 1040))


def ripple_rad(phase: np.ndarray) -> float:
    """Amplitude of the third harmonic over the wall: unwrapped along the rows, less a smooth surface."""
    unwrapped = np.unwrap(np.unwrap(phase, axis=1), axis=0)
    v, u = np.mgrid[-1 : 1 : phase.shape[0] * 1j, -1 : 1 : phase.shape[1] * 1j]
    terms = np.stack([u**i * v**j for i in range(6) for j in range(4)], axis=-1).reshape(-1, 24)
    smooth = terms @ np.linalg.lstsq(terms, unwrapped.ravel(), rcond=None)[0]
    rest = unwrapped.ravel() - smooth
    return float(2 * np.abs(np.mean(rest * np.exp(-3j * smooth))))


def test_the_ripple_of_real_images_is_measured_and_removed(real: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    frames, white, black = real
    for steps in (slice(0, 3), slice(3, 6)):
        samples = normalised(frames[(steps, *WALL)], white[WALL], black[WALL])
        response = measure(samples)
        before, after = ripple_rad(wrapped(samples)), ripple_rad(wrapped(response.linear(samples)))
        assert before == pytest.approx(0.35, abs=0.02)  # its root mean square is 0.25 rad
        assert after < 0.03
        assert response.residual < response.residual_before / 4


def test_a_scene_that_breaks_the_assumption_is_seen_in_the_residual(
    real: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:
    frames, white, black = real  # blurred, shadowed and lit across corners: not one response for all of it
    assert measure(normalised(frames[:3], white, black)).residual > 0.1


def test_real_images_decode_to_an_absolute_phase_within_the_beat(
    real: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:
    frames, white, black = real
    samples = normalised(frames[(slice(None), *WALL)], white[WALL], black[WALL])
    linear = measure(samples[:3]).linear(samples)
    # Pitches of 200/3 and 100 px: three and two periods in the beat of 200 px.
    patterns = tuple(Pattern(f, s) for f in (3.0, 2.0) for s in SHIFTS)
    found = projector_map(linear, patterns, 200)
    x = found.coordinate_px
    assert np.isfinite(x).mean() > 0.98
    assert np.nanmin(x) > -10  # noise may carry it over the beat's ends
    assert np.nanmax(x) < 210
    # Along the wall the coordinate runs on smoothly, modulo the beat: no wrong fringe order in either direction.
    for axis in (0, 1):
        step = np.diff(x, axis=axis)
        step = (step + 100) % 200 - 100
        good = np.abs(step[np.isfinite(step)]) < 200 / 6
        assert good.mean() > 0.999
