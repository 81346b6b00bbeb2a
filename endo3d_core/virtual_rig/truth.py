"""What a perfect measurement would give: depth, projector coordinate, phase and visibility of every pixel.

In float64 and in closed form, apart from the renderer's tables: what frames are compared with.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from endo3d_core.calibration import Rig
from endo3d_core.head import Head
from endo3d_core.virtual_rig import casting
from endo3d_core.virtual_rig.outline import inside
from endo3d_core.virtual_rig.scene import Scene

SHADOW_MM = 1e-6
"""How much nearer to the projector something must be to throw a shadow on a point."""


@dataclass(frozen=True, eq=False)
class Truth:
    """One pose's truth on the camera's pixels; NaN where nothing is seen."""

    depth_mm: NDArray[np.float64]
    """(height, width) along the camera's axis."""
    projector_px: NDArray[np.float64]
    """(height, width, 2) where on the projector the light of a pixel comes from."""
    visible: NDArray[np.bool_]
    """(height, width) seen by the camera's fibre, lit by the projector's, not in shadow."""

    def points(self, rays: NDArray[np.float64]) -> NDArray[np.float64]:
        """(height, width, 3) mm in the camera's axes, from the camera's rays with z = 1."""
        return np.asarray(self.depth_mm[..., None] * rays)

    def phase_rad(self, frequency: float, period_px: int, axis: int = 0) -> NDArray[np.float64]:
        """(height, width) absolute phase of a pattern with ``frequency`` periods over ``period_px``."""
        return np.asarray(2 * math.pi * frequency / period_px * self.projector_px[..., axis])


def truth(rig: Rig, head: Head, scene: Scene, T_scene_camera: NDArray[np.float64], bin_px: int = 1) -> Truth:
    """What the head sees from a pose, on a camera binned by ``bin_px``."""
    camera = rig.camera.binned(bin_px) if bin_px > 1 else rig.camera
    rays = camera.ray(camera.pixel_grid())
    depth = depths(scene, T_scene_camera, rays[..., :2])
    points = depth[..., None] * rays
    in_projector = rig.to_projector(points)
    pixel = rig.projector.project(in_projector)
    with np.errstate(invalid="ignore"):
        towards = in_projector[..., :2] / in_projector[..., 2:]
        T_scene_projector = T_scene_camera @ np.linalg.inv(rig.T_projector_camera)
        lit = in_projector[..., 2] <= depths(scene, T_scene_projector, towards) + SHADOW_MM
        visible = inside(camera, camera.pixel_grid(), head.camera_circle_px / bin_px)
        visible &= inside(rig.projector, pixel, head.projector_circle_px) & lit & np.isfinite(depth)
    return Truth(depth, pixel, visible)


def distance(scene: Scene, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 3) points of the scene's axes -> (n,) signed distances to the nearest surface, mm.

    Positive on the sensor's side. For ``metrology.surface_error``.
    """
    nearest = np.full(len(points), np.inf)
    for body in scene.bodies:
        T_body_scene = np.linalg.inv(body.T_scene_body)
        local = np.ascontiguousarray(points @ T_body_scene[:3, :3].T + T_body_scene[:3, 3], np.float64)
        d = casting.distances(body.shape, local)
        nearest = np.where(np.abs(d) < np.abs(nearest), d, nearest)
    return nearest


def depths(scene: Scene, T_scene_view: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 2) rays (x, y, 1) of a view -> (...) depth at which each first meets the scene, NaN for never."""
    x, y = (np.ascontiguousarray(rays[..., k], np.float64).ravel() for k in (0, 1))
    z = np.full(x.size, np.inf)
    for body in scene.bodies:
        casting.cast_exact(body.shape, np.linalg.inv(body.T_scene_body) @ T_scene_view, x, y, z)
    return np.where(np.isfinite(z), z, np.nan).reshape(rays.shape[:-1])
