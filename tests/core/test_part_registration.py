"""Where a scan lies on a CAD model: a relief with known poses, told roughly."""

from __future__ import annotations

import numpy as np
import pytest

from endo3d_core import rigid
from endo3d_core.part_registration import Fit, Part, PartRegistration
from endo3d_core.registration import Frame6

RADIUS_MM = 2.0
T_PART_SCENE = rigid.exp([30.0, 5.0, -7.0, 0.4, 1.2, -0.3])
T_SCENE_CAMERA = rigid.exp([0.5, -0.3, -20.0, 0.02, 0.05, -0.04])
FRAME = Frame6(np.array([0.0, 0.0, 20.0]), RADIUS_MM)


def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Bumps that repeat nowhere."""
    return 0.4 * np.sin(1.1 * x + 0.3 * y) + 0.3 * np.cos(0.7 * y - 0.2 * x * y) + 0.05 * x**2


def ridge(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The same all along y."""
    return 0.5 * np.exp(-(x**2)) + 0.1 * x + 0.0 * y


def model(surface=height) -> Part:
    side = np.linspace(-5.0, 5.0, 101)
    X, Y = np.meshgrid(side, side)
    vertices = np.stack([X, Y, -surface(X, Y)], axis=-1).reshape(-1, 3)
    a = (np.arange(100)[:, None] * 101 + np.arange(100)).ravel()
    b, c, d = a + 1, a + 101, a + 102
    faces = np.stack([[a, c, b], [b, c, d]]).transpose(0, 2, 1).reshape(-1, 3)
    return Part(rigid.apply(T_PART_SCENE, vertices), faces)


def seen(surface=height, noise_mm: float = 0.001, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Map points and normals in the world (the first camera), 4 mm around the middle of the view."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-2.0, 2.0, (2, 3000)) + np.array([[0.5], [-0.3]])
    e = 1e-4
    slope_x = (surface(x + e, y) - surface(x - e, y)) / (2 * e)
    slope_y = (surface(x, y + e) - surface(x, y - e)) / (2 * e)
    normals = -np.stack([slope_x, slope_y, np.ones_like(x)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = np.stack([x, y, -surface(x, y)], axis=1) + noise_mm * rng.standard_normal((3000, 1)) * normals
    T = rigid.inverse(T_SCENE_CAMERA)
    return rigid.apply(T, points), normals @ T[:3, :3].T


def off_um(registration: PartRegistration) -> float:
    """Error of where the middle of the view lies on the part."""
    true = T_PART_SCENE @ T_SCENE_CAMERA
    error = rigid.apply(registration.estimate.T_part_world, FRAME.centre) - rigid.apply(true, FRAME.centre)
    return float(1e3 * np.linalg.norm(error))


def test_a_pose_that_was_told_roughly_comes_to_lie_on_the_model() -> None:
    near = T_PART_SCENE @ T_SCENE_CAMERA @ rigid.exp([0.2, -0.2, 0.2, 0.02, -0.01, 0.02])
    registration = PartRegistration(model(), RADIUS_MM, near)
    for k in range(4):
        registration.look(*seen(seed=k), np.eye(4), FRAME)
    assert registration.estimate.state is Fit.ALIGNED
    assert off_um(registration) < 10.0
    assert registration.estimate.inlier_share > 0.9
    assert registration.estimate.residual_mm < 0.005
    assert np.linalg.eigvalsh(registration.estimate.information)[0] > 0.0


def test_along_a_ridge_the_place_is_unknown_and_that_is_said() -> None:
    near = T_PART_SCENE @ T_SCENE_CAMERA
    registration = PartRegistration(model(ridge), RADIUS_MM, near)
    for k in range(3):
        registration.look(*seen(ridge, seed=k), np.eye(4), FRAME)
    estimate = registration.estimate
    assert estimate.state is Fit.DEGENERATE
    along = (T_PART_SCENE @ T_SCENE_CAMERA)[:3, :3].T @ T_PART_SCENE[:3, :3] @ [0.0, 1.0, 0.0]
    assert abs(estimate.weak_direction[:3] @ along) > 0.9
    assert off_um(registration) < 30.0, "what can't be told is left where it was"


def test_another_surface_is_not_the_part() -> None:
    near = T_PART_SCENE @ T_SCENE_CAMERA
    registration = PartRegistration(model(), RADIUS_MM, near)
    points, normals = seen(lambda x, y: 0.9 * np.cos(3.0 * x) * np.sin(2.5 * y))
    registration.look(points, normals, np.eye(4), FRAME)
    assert registration.estimate.state is Fit.SEARCHING
    assert not registration.estimate.information.any()


def test_samples_cover_every_facet_and_lie_on_it() -> None:
    part = Part(np.array([[0.0, 0, 0], [4, 0, 0], [0, 3, 0], [0, 0, 0.001]]), np.array([[0, 1, 2], [0, 2, 3]]))
    points, normals = part.sampled(0.1)
    flat = normals[:, 2] > 0.9
    assert 500 < flat.sum() < 2000
    assert (~flat).any()
    assert np.abs(points[flat, 2]).max() < 1e-12
    assert (points[flat, 0] / 4 + points[flat, 1] / 3).max() <= 1.0 + 1e-12


def test_a_model_without_facets_is_refused() -> None:
    with pytest.raises(ValueError, match="no facet"):
        Part(np.zeros((3, 3)), np.array([[0, 1, 2]]))
