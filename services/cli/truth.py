"""A simulated scan against the truth: the way of the tip, and the merged surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d.schemas.messages import Pose, Tracking, Truth
from endo3d_core import rigid
from endo3d_core.metrology import SurfaceError, surface_error
from endo3d_core.trajectory import TrajectoryError, align, ate
from endo3d_core.virtual_rig import scene, truth


@dataclass(frozen=True)
class Comparison:
    """How far a scan is from what the virtual rig knows."""

    trajectory: TrajectoryError
    lost_share: float
    """Poses that odometry itself called lost; they are left out of the trajectory's error."""
    surface: SurfaceError
    deviation_um: NDArray[np.float64]
    """(n,) signed distance of every map point to the true surface."""


def compare(poses: list[Pose], truths: list[Truth], points: NDArray[Any]) -> Comparison | None:
    """points (n,) structured, world frame. None without truth, or without three tracked poses.

    The scan's world is laid onto the scene by the trajectory alone; the surface is not fitted.
    """
    known = {known_pose.stamp_ns: known_pose.T_scene_camera for known_pose in truths}
    tracked = [pose for pose in poses if pose.stamp_ns in known and pose.state is not Tracking.LOST]
    if len(tracked) < 3 or not len(points):
        return None
    estimated = np.stack([pose.T_world_camera for pose in tracked])
    true = np.stack([known[pose.stamp_ns] for pose in tracked])
    T_scene_world = align(estimated, true)[0] @ rigid.inverse(estimated[0])
    xyz = np.stack([points[axis] for axis in "xyz"], axis=-1).astype(np.float64)
    in_scene = xyz @ T_scene_world[:3, :3].T + T_scene_world[:3, 3]
    true_scene = scene.parse(truths[0].scene)
    distance_mm = truth.distance(true_scene, in_scene)
    return Comparison(
        ate(estimated, true),
        1.0 - len(tracked) / len(poses),
        surface_error(in_scene, lambda _: distance_mm),
        1e3 * distance_mm,
    )
