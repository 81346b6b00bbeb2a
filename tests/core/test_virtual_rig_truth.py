"""The rig's truth against solutions that share no code with it, and the renderer against the truth."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from endo3d_core import patterns
from endo3d_core.calibration import Rig
from endo3d_core.head import Head
from endo3d_core.virtual_rig import contour_standard as standard
from endo3d_core.virtual_rig import freeform, motion, scene
from endo3d_core.virtual_rig.effects import IDEAL
from endo3d_core.virtual_rig.renderer import Renderer
from endo3d_core.virtual_rig.truth import Truth, distance, truth

HEADS = Path(__file__).parents[2] / "deploy" / "heads"
NAMES = ("base6_wd10", "base6_wd20", "base35_wd10", "base35_wd20")
BIN = 8


@cache
def head_of(name: str) -> tuple[Rig, Head]:
    text = (HEADS / f"{name}.yaml").read_text()
    return Rig.from_yaml(text), Head.from_yaml(text)


def seen(text: str, T: NDArray[np.float64], name: str = "base6_wd20") -> tuple[Truth, NDArray[np.float64]]:
    """The truth, and its points in the scene's axes."""
    rig, head = head_of(name)
    result = truth(rig, head, scene.parse(text, head.working_distance_mm), T, BIN)
    camera = rig.camera.binned(BIN)
    points = result.points(camera.ray(camera.pixel_grid()))
    return result, points @ T[:3, :3].T + T[:3, 3]


A_POSE = motion.transform((0.3, -0.2, 0.4), (0.02, -0.03, 0.1))


@pytest.mark.parametrize("name", NAMES)
def test_depth_and_projector_pixels_agree_with_opencv(name: str) -> None:
    """Through OpenCV's lens model, the truth's points fall on their camera and projector pixels."""
    rig, _ = head_of(name)
    result, points = seen("plane tilt=15,-10", np.eye(4), name)
    ok = result.visible
    assert ok.mean() > 0.2
    camera, projector = rig.camera.binned(BIN), rig.projector
    uv, _ = cv2.projectPoints(points[ok], np.zeros(3), np.zeros(3), camera.K, camera.dist)
    assert np.abs(uv[:, 0] - camera.pixel_grid()[ok]).max() < 1e-7
    r, _ = cv2.Rodrigues(rig.R)
    shown, _ = cv2.projectPoints(points[ok], r, rig.t, projector.K, projector.dist)
    assert np.abs(shown[:, 0] - result.projector_px[ok]).max() < 1e-7


def test_points_of_a_tilted_plane_lie_on_it() -> None:
    _, points = seen("plane z=21 tilt=20,10", A_POSE)
    a, b = np.radians((20.0, 10.0))
    # Turned about y by a, then about its own x by b: the normal by hand.
    normal = np.array((np.cos(b) * np.sin(a), -np.sin(b), np.cos(b) * np.cos(a)))
    off = (points - (0.0, 0.0, 21.0)) @ normal
    assert np.nanmax(np.abs(off)) < 1e-6 / 1000


def test_points_of_a_sphere_lie_on_its_near_side() -> None:
    result, points = seen("sphere r=2 at=0.4,-0.3,20", A_POSE)
    ok = np.isfinite(result.depth_mm)
    from_centre = points[ok] - (0.4, -0.3, 20.0)
    assert np.abs(np.linalg.norm(from_centre, axis=1) - 2.0).max() < 1e-9
    towards_camera = A_POSE[:3, 3] - points[ok]
    assert (np.sum(from_centre * towards_camera, axis=1) > -1e-9).all()
    # All of the outline is there: the cone under which a sphere is seen covers this many pixels.
    rig, _ = head_of("base6_wd20")
    camera = rig.camera.binned(BIN)
    rays = camera.ray(camera.pixel_grid()) @ A_POSE[:3, :3].T
    to_centre = np.array((0.4, -0.3, 20.0)) - A_POSE[:3, 3]
    cosine = rays @ to_centre / np.linalg.norm(rays, axis=-1) / np.linalg.norm(to_centre)
    inside = cosine > np.sqrt(1 - (2.0 / np.linalg.norm(to_centre)) ** 2)
    assert (inside == ok).all()


def test_a_cylinder_of_any_axis_has_its_radius() -> None:
    turn = np.radians((0.0, 10.0, 20.0))
    result, points = seen("cylinder r=1.5 at=0,0,20 turn=0,10,20", np.eye(4))
    ok = np.isfinite(result.depth_mm)
    axis = motion.transform((0, 0, 0), turn)[:3, 1]
    across = points[ok] - (0.0, 0.0, 20.0)
    across -= np.outer(across @ axis, axis)
    # The half cylinder is open at the back: only its round front is seen from here.
    assert np.abs(np.linalg.norm(across, axis=1) - 1.5).max() < 1e-9


def test_the_contour_standard_has_its_calibrated_dimensions() -> None:
    """Table 5, read off the truth at several places along the scan by plain geometry."""
    heights: list[NDArray[np.float64]] = []
    for x in (-6.0, 0.0, 4.0):
        _, points = seen("contour", motion.transform((x, 0.0, 0.0)))
        heights.append(points[np.isfinite(points[..., 2])] * (1, 1, -1) + (0, 0, 20.0))
    p = np.concatenate(heights)
    x, h = p[:, 0], p[:, 2]

    def radius(at: float, half: float) -> float:
        part = np.abs(x - at) < half
        A = np.stack((2 * x[part], 2 * h[part], np.ones(part.sum())), axis=1)
        cx, ch, c = np.linalg.lstsq(A, x[part] ** 2 + h[part] ** 2, rcond=None)[0]
        return float(np.sqrt(c + cx**2 + ch**2))

    assert radius(standard.LARGE_CYLINDER_X_MM, 0.7) == pytest.approx(0.9987, abs=1e-6)
    assert radius(standard.SMALL_CYLINDER_X_MM, 0.35) == pytest.approx(0.4987, abs=1e-6)
    before, top, after = (np.median(h[(x > a) & (x < b)]) for a, b in ((-3.6, -3), (-2, -1), (1, 2)))
    assert top - before == pytest.approx(1.0005, abs=1e-9)
    assert top - after == pytest.approx(0.5004, abs=1e-9)
    left = np.polyfit(*p[(x > 3.2) & (x < 3.9)][:, (0, 2)].T, 1)[0]
    right = np.polyfit(*p[(x > 4.3) & (x < 5.0)][:, (0, 2)].T, 1)[0]
    assert 180 - np.degrees(np.arctan(left) - np.arctan(right)) == pytest.approx(89.96, abs=1e-6)


def test_shadow_of_a_sphere_is_its_central_projection() -> None:
    """A plane point is dark exactly where the line to the projector passes the sphere within its radius."""
    rig, _ = head_of("base6_wd20")
    result, points = seen("plane z=21 + sphere r=0.8 at=0,0,19", np.eye(4))
    on_plane = np.isfinite(result.depth_mm) & (np.abs(points[..., 2] - 21.0) < 1e-9)
    lamp = rig.projector_centre_mm
    along = lamp - points
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    miss = np.linalg.norm(np.cross(np.array((0, 0, 19.0)) - points, along), axis=-1)
    clear, dark = on_plane & (miss > 0.8 + 1e-9), on_plane & (miss < 0.8 - 1e-9)
    inside = np.linalg.norm(points[..., :2], axis=-1) < 4.0  # well within both fields
    assert result.visible[clear & inside].all()
    assert not result.visible[dark & inside].any()
    assert (dark & inside).sum() > 30


@pytest.mark.parametrize(
    "text", ["contour", "plane tilt=25", "sphere r=3 at=0,0,21", "cylinder r=2", "steps heights=0.1/0.5", "blade"]
)
def test_the_renderer_shows_the_true_phase(text: str) -> None:
    check_phase(text)


def test_the_renderer_shows_the_true_phase_of_a_mesh(ball_file: Path) -> None:
    check_phase(f"mesh file={ball_file} at=0,0,21 + plane z=21.5")


def check_phase(text: str) -> None:
    """Ideal frames of a phase-shifted pattern give back the truth's phase on every visible pixel."""
    rig, head = head_of("base6_wd20")
    what = scene.parse(text)
    T = motion.transform((0.5, 0.1, -0.3), (0.01, 0.02, -0.05))
    renderer = Renderer(rig, head, what, IDEAL, bin_px=2)
    n = rig.projector.width
    waves = [
        renderer.exposure(renderer.light(patterns.image(p, n, n)), [T]).copy()
        for p in patterns.conventional((25.0,), (4,)).patterns
    ]
    expected = truth(rig, head, what, T, 2)
    measured = np.arctan2(waves[3] - waves[1], waves[0] - waves[2])
    wanted = expected.phase_rad(25.0, n).ravel()[renderer.where]
    error = np.angle(np.exp(1j * (measured - wanted)))
    modulation = np.hypot(waves[3] - waves[1], waves[0] - waves[2])
    ok = expected.visible.ravel()[renderer.where] & (modulation > 1e-3)
    assert ok.mean() > 0.05
    # Grey levels and the DMD's pixels leave some mrad; outlines may differ by a step of the table.
    assert np.quantile(np.abs(error[ok]), 0.99) < 0.02
    assert np.abs(np.mean(error[ok])) < 1e-3


@pytest.mark.parametrize(
    "text", ["contour", "plane tilt=20,10", "sphere r=2 + plane z=21", "cylinder r=1.5 turn=0,0,30", "blade"]
)
def test_distance_is_zero_on_the_surface_and_grows_along_its_normal(text: str) -> None:
    """True points have no distance; moved 50 um towards the camera they are in front by at most that."""
    what = scene.parse(text)
    result, points = seen(text, A_POSE)
    on = points[np.isfinite(result.depth_mm)]
    assert np.abs(distance(what, on)).max() < 1e-9
    towards = A_POSE[:3, 3] - on
    moved = distance(what, on + 0.05 * towards / np.linalg.norm(towards, axis=1, keepdims=True))
    assert moved.max() <= 0.05 + 1e-12
    assert moved.min() > -1e-9
    assert np.median(moved) > 0.04


def test_points_of_a_blade_satisfy_its_equation() -> None:
    result, points = seen("blade at=0.2,0.1,20", A_POSE)
    ok = np.isfinite(result.depth_mm)
    x, y, z = (points[ok] - (0.2, 0.1, 20.0)).T
    a, b, c, d, e = freeform.BLADE
    assert np.abs(z - (a * x**2 + b * x**3 + c * x**4 + d * y**2 + e * x * y)).max() < 1e-9
    assert np.abs(x).max() <= 5.0
    assert ok.sum() > 5000


@pytest.fixture(scope="module")
def ball_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finely triangulated sphere of 3 mm, centred on its origin."""
    trimesh = pytest.importorskip("trimesh")
    for package in ("embreex", "rtree"):
        pytest.importorskip(package, reason="mesh scenes need it: pip install 'endo3d[mesh]'")
    path = tmp_path_factory.mktemp("mesh") / "ball.stl"
    trimesh.creation.icosphere(subdivisions=5, radius=3.0).export(path)
    return path


def test_a_mesh_is_seen_where_its_triangles_are(ball_file: Path) -> None:
    """A mesh of a sphere agrees with the sphere to within the sagitta of its triangles, and with its own faces."""
    result, points = seen(f"mesh file={ball_file} at=0,0,21", A_POSE)
    ideal, _ = seen("sphere r=3 at=0,0,21", A_POSE)
    both = np.isfinite(result.depth_mm) & np.isfinite(ideal.depth_mm)
    assert both.sum() > 0.97 * np.isfinite(ideal.depth_mm).sum()
    radius = np.linalg.norm(points[both] - (0, 0, 21.0), axis=1)
    assert radius.max() <= 3.0 + 1e-6
    assert radius.min() > 3.0 - 0.004
    what = scene.parse(f"mesh file={ball_file} at=0,0,21")
    some = points[both][::500]
    assert np.abs(distance(what, some)).max() < 1e-6
    assert distance(what, some - (0.0, 0.0, 0.1)).min() > 0.01


def test_a_mesh_that_is_none_gets_one_line(tmp_path: Path) -> None:
    (tmp_path / "empty.stl").write_bytes(b"solid nothing")
    for text, hint in (
        ("mesh", "needs file="),
        (f"mesh file={tmp_path / 'absent.stl'}", "can't be read"),
        (f"mesh file={tmp_path / 'empty.stl'}", "triangles|can't be read"),
    ):
        with pytest.raises(ValueError, match=hint):
            scene.parse(text)
