"""Odometry on simulated clouds with known poses: analytic surfaces and white noise, no decoder."""

from __future__ import annotations

import numpy as np
import pytest

from endo3d_core import simulated_clouds as sim
from endo3d_core import trajectory
from endo3d_core.odometry import Estimate, Odometry, State

SMALL = sim.Sensor(width=240, height=160)
"""A coarser grid over the same field: a third of the work."""


def scan(
    odometry: Odometry,
    scene: str,
    duration_s: float = 0.5,
    sensor: sim.Sensor = SMALL,
    keep: slice = slice(None),
) -> tuple[list[Estimate], np.ndarray, np.ndarray]:
    """Estimates, estimated poses and true poses of a hand-guided scan."""
    estimates, truth = [], []
    for cloud in list(sim.clouds(sim.SCENES[scene](), sim.HandMotion(), duration_s, sensor=sensor))[keep]:
        estimates.append(odometry.track(cloud.channels, cloud.sequence, cloud.stamp_ns))
        truth.append(cloud.T_scene_camera)
    return estimates, np.array([e.T_world_camera for e in estimates]), np.array(truth)


@pytest.mark.parametrize("scene", sorted(sim.SCENES))
def test_textured_scenes_are_tracked_to_ten_um(scene: str) -> None:
    estimates, poses, truth = scan(Odometry(), scene)
    assert {e.state for e in estimates} == {State.TRACKING}
    assert trajectory.ate(poses, truth).rms_um < 10.0


def test_without_texture_the_extrusion_is_held_and_reported() -> None:
    bare = sim.Sensor(width=240, height=160, texture=0.0)
    estimates, poses, truth = scan(Odometry(), "contour", sensor=bare)
    assert {e.state for e in estimates[2:]} == {State.DEGENERATE}
    assert all(abs(e.weak_direction[1]) > 0.95 for e in estimates[10:])
    assert all(e.photometric_share == 0.0 for e in estimates)
    moved = np.linalg.inv(truth[0]) @ truth
    error_um = 1e3 * (poses[:, :3, 3] - moved[:, :3, 3])
    assert np.abs(error_um[:, [0, 2]]).max() < 20.0
    assert np.ptp(poses[:, 1, 3]) < 0.3, "the held direction must not run away"
