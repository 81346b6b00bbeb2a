"""The fits recover what the points were made from, with noise and with outliers."""

from __future__ import annotations

import numpy as np
import pytest

from endo3d_core import metrology

RNG_SEED = 7
NOISE_MM = 0.005


def patch(n: int) -> tuple[np.ndarray, np.ndarray, np.random.Generator]:
    rng = np.random.default_rng(RNG_SEED)
    return rng.uniform(-1, 1, n), rng.uniform(-1, 1, n), rng


def spoil(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    noisy = points + rng.normal(0, NOISE_MM, points.shape)
    outliers = rng.random(len(points)) < 0.03
    noisy[outliers] += rng.uniform(0.1, 0.6, (int(outliers.sum()), 3))
    noisy[::97] = np.nan
    return noisy


def test_plane() -> None:
    x, y, rng = patch(4000)
    points = spoil(np.column_stack([x, y, 20 + 0.3 * x - 0.1 * y]), rng)
    plane = metrology.fit_plane(points)
    normal = np.array([-0.3, 0.1, 1.0]) / np.linalg.norm([-0.3, 0.1, 1.0])
    assert abs(plane.normal @ normal) > 1 - 1e-6
    assert abs(abs(plane.offset_mm) - 20 * normal[2]) < 5e-4


def test_sphere_cap() -> None:
    x, y, rng = patch(6000)
    theta, phi = 1.1 * np.abs(x), np.pi * y
    points = np.column_stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), 19 - np.cos(theta)])
    sphere = metrology.fit_sphere(spoil(points, rng))
    assert sphere.radius_mm == pytest.approx(1.0, abs=2e-3)
    np.testing.assert_allclose(sphere.centre, [0, 0, 19], atol=2e-3)
    given = metrology.fit_sphere(spoil(points, rng), radius_mm=1.0)
    assert given.radius_mm == 1.0
    np.testing.assert_allclose(given.centre, [0, 0, 19], atol=1e-3)


@pytest.mark.parametrize("axis", [None, (0.1, 1.0, 0.0)])
def test_cylinder_section(axis: tuple[float, float, float] | None) -> None:
    x, y, rng = patch(6000)
    theta = 1.1 * x
    points = np.column_stack([0.5 * np.sin(theta), 2 * y, 20 - 0.5 * np.cos(theta)])
    cylinder = metrology.fit_cylinder(spoil(points, rng), axis)
    assert cylinder.radius_mm == pytest.approx(0.5, abs=1e-3)
    assert abs(cylinder.axis[1]) > 1 - 1e-5
    np.testing.assert_allclose(cylinder.centre[[0, 2]], [0, 20], atol=1e-3)


def test_step_and_wedge() -> None:
    x, y, rng = patch(4000)
    low = metrology.fit_plane(spoil(np.column_stack([x, y, np.full_like(x, 20.0)]), rng))
    high = np.column_stack([x, y, rng.normal(19.0, NOISE_MM, len(x))])
    height, form_um = metrology.step_height_mm(low, high)
    assert height == pytest.approx(1.0, abs=5e-4)
    assert form_um == pytest.approx(1e3 * NOISE_MM, rel=0.1)
    for opening in (90.0, 60.0, 120.0):
        slope = 1.0 / np.tan(np.radians(opening / 2))
        left = metrology.fit_plane(np.column_stack([x - 1, y, slope * (1 - x)]))
        right = metrology.fit_plane(np.column_stack([x + 1, y, slope * (1 + x)]))
        assert metrology.wedge_angle_deg(left, right, inside=(0, 0, 5)) == pytest.approx(opening, abs=1e-6)


def test_surface_error_counts_only_valid_points() -> None:
    points = np.array([[0, 0, 0.001], [1, 0, -0.001], [np.nan, 0, 0]])
    error = metrology.surface_error(points, lambda p: p[:, 2])
    assert (error.count, error.mean_um, error.std_um) == (2, 0.0, pytest.approx(1.0))


def test_too_few_points_say_so() -> None:
    with pytest.raises(ValueError, match="2 valid points"):
        metrology.fit_plane(np.zeros((2, 3)))
