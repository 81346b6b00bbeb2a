"""Points that the projector does not light, and points that stand alone, go; all others stay as they are."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray
from planes import HEADS, Plane, head_rig

from endo3d_core import triangulation
from endo3d_core.calibration import Rig
from endo3d_core.head import Head
from endo3d_core.projector_field import RIM_PITCHES, ProjectorField, depth_limits

BIN = 8


@cache
def setting() -> tuple[Rig, Head, NDArray[np.float32]]:
    rig, head = head_rig(), Head.from_yaml((HEADS / "base6_wd20.yaml").read_text())
    return rig, head, depth_limits(rig, head, BIN, head.z_min_mm, head.z_max_mm)


def plane(z_mm: float) -> np.ndarray:
    """(150, 240, 6) points of a plane across the axis, all with sigma 0.001 and quality 1."""
    rays = setting()[0].camera.ray(triangulation.grid_pixels(setting()[0], BIN, "columns"))
    points = np.ones((*rays.shape[:2], 6), np.float32)
    points[..., :3] = rays * Plane(z_mm, 0.05, 0.0).depth(rays)[..., None]
    points[..., 5] = 0.001
    return points


def test_what_is_left_lies_within_the_projectors_disc() -> None:
    rig, head, limits = setting()
    for z_mm in (17.5, 20.0, 22.5):
        points = plane(z_mm)
        before = points.copy()
        count = ProjectorField(limits).keep(points)
        kept = np.isfinite(points[..., 2])
        assert count == kept.sum()
        np.testing.assert_array_equal(points[kept], before[kept])
        assert np.isnan(points[~kept][:, (0, 1, 2, 5)]).all()
        assert (points[~kept][:, 4] == 0).all()
        at = rig.projector_pixel(before[..., :3].astype(np.float64))
        off = np.hypot(at[..., 0] - (rig.projector.width - 1) / 2, at[..., 1] - (rig.projector.height - 1) / 2)
        radius = head.projector_circle_px / 2 - RIM_PITCHES * head.projector_pitch_px
        tolerance = 3.0  # px: depths are tried 0.1 mm apart, every 32 camera px
        assert off[kept].max() < radius + tolerance
        inner = np.zeros(kept.shape, np.bool_)
        inner[1:-1, 1:-1] = True
        assert kept[inner & (off < radius - tolerance)].mean() > 0.995


def test_points_that_stand_alone_go_and_leave_the_depth_map_too() -> None:
    points = plane(20.0)
    points[75, 120, 2] += 0.4
    points[60:63, 110:113, 2] += 0.4  # a small plateau supports itself, but for its corners' neighbours
    depth = np.full(points.shape[:2], 7, np.uint16)
    ProjectorField(setting()[2]).keep(points, depth)
    assert np.isnan(points[75, 120, 2])
    assert np.isfinite(points[60:63, 110:113, 2]).all()
    np.testing.assert_array_equal(depth > 0, np.isfinite(points[..., 2]))
    alone = plane(20.0)
    alone[75, 120, 2] += 0.4
    ProjectorField(setting()[2], support=0).keep(alone)
    assert np.isfinite(alone[75, 120, 2])
