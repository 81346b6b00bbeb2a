"""The software renderer: what is in view, what is in front, where it is."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from endo3d.services.views.principal import heights_mm, principal, without_strays
from endo3d.services.views.splat import Eye, looking, render


@given(
    st.lists(st.tuples(*[st.floats(-30, 30)] * 3), min_size=2, max_size=30),
    st.tuples(*[st.floats(-1, 1)] * 3).filter(
        lambda d: np.linalg.norm(d) > 0.3 and abs(d[2]) < 0.95 * np.linalg.norm(d)
    ),
)
def test_looking_sees_all_and_wastes_nothing(
    points: list[tuple[float, float, float]], direction: tuple[float, float, float]
) -> None:
    at = np.array(points)
    at[0] += 0.5  # two points at least a bit apart
    eye = looking(at, np.array(direction), np.array([0.0, 0, 1]), (400, 300), margin=0.1)
    u, v, depth = eye.project(at).T
    assert np.allclose(eye.R @ eye.R.T, np.eye(3))
    assert np.linalg.det(eye.R) == pytest.approx(1.0)
    assert (depth > 0).all()
    assert (u > 40 - 0.5).all()
    assert (u < 360 + 0.5).all()
    assert (v > 30 - 0.5).all()
    assert (v < 270 + 0.5).all()
    touches_sides = u.min() < 40.5 and u.max() > 359.5
    touches_ends = v.min() < 30.5 and v.max() > 269.5
    extent_mm = np.linalg.norm(np.ptp(at, axis=0))
    assert touches_sides or touches_ends or depth.min() == pytest.approx(0.3 * extent_mm, rel=1e-6)


def wall(z_mm: float, half_mm: float) -> np.ndarray:
    x, y = np.meshgrid(np.arange(-half_mm, half_mm, 0.05), np.arange(-half_mm, half_mm, 0.05))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, z_mm)], axis=1)


EYE = Eye(np.eye(3), np.zeros(3), 400.0, 320, 240)


def test_the_nearer_wall_hides_the_farther() -> None:
    near, far = wall(20.0, 2.0), wall(30.0, 12.0)
    points = np.concatenate([far, near])
    rgb = np.repeat(np.array([[0, 0, 200], [200, 0, 0]], np.uint8), [len(far), len(near)], axis=0)
    image, depth = render(points, rgb, EYE, 0.05)
    assert depth[120, 160] == pytest.approx(20.0, abs=1e-3)
    assert depth[20, 20] == pytest.approx(30.0, abs=1e-3)
    assert image[120, 160].argmax() == 0
    assert image[20, 20].argmax() == 2
    edge_px = 160 + 400 * 2.0 / 20
    across = depth[120] < 25
    assert np.flatnonzero(across).max() == pytest.approx(edge_px, abs=2)


def test_a_closed_wall_has_no_holes_and_nothing_is_where_no_point_is() -> None:
    _, depth = render(wall(20.0, 4.0), np.full((len(wall(20.0, 4.0)), 3), 128, np.uint8), EYE, 0.05)
    inside = np.s_[120 - 70 : 120 + 70, 160 - 70 : 160 + 70]
    assert np.isfinite(depth[inside]).all()
    assert np.isinf(depth[:, :70]).all()


def test_no_point_is_a_picture_of_the_background() -> None:
    image, depth = render(np.empty((0, 3)), np.empty((0, 3), np.uint8), EYE, 0.05)
    assert np.isinf(depth).all()
    assert image.std(axis=1).max() == 0  # rows are even


def test_height_is_over_the_mean_plane_towards_the_viewer() -> None:
    rng = np.random.default_rng(5)
    xy = rng.uniform(-5, 5, (4000, 2)) * (3, 1)
    bumps = np.where(rng.random(4000) < 0.5, 0.1, -0.1)
    tilt = np.array([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]])
    points = np.column_stack([xy, -bumps]) @ tilt.T + (1, 2, 20)
    heights = heights_mm(points, np.zeros(3))
    np.testing.assert_allclose(heights, bumps, atol=0.01)
    axes, _ = principal(points, np.zeros(3))
    np.testing.assert_allclose(abs(axes @ tilt), np.eye(3), atol=0.01)


def test_a_few_strays_do_not_choose_the_view() -> None:
    points = np.concatenate([wall(20.0, 4.0), [[0, 0, 60], [90, 0, 20], [0, -80, 20]]])
    kept = without_strays(points)
    np.testing.assert_array_equal(kept, wall(20.0, 4.0))
