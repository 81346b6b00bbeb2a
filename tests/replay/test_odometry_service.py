"""The odometry service on simulated clouds: what it says about clouds that it did not get."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from endo3d.schemas import topics
from endo3d.schemas.messages import POINT, Cloud, Pose, Tracking
from endo3d.services.odometry import Odometry, OdometryConfig
from endo3d_core import simulated_clouds as sim
from endo3d_core import trajectory

SMALL = sim.Sensor(width=240, height=160)


def simulated(duration_s: float) -> Iterator[tuple[Cloud, np.ndarray]]:
    """Clouds of a hand-guided scan and their true poses."""
    for cloud in sim.clouds(sim.contour_standard(), sim.HandMotion(), duration_s, sensor=SMALL):
        message = Cloud(
            stamp_ns=cloud.stamp_ns,
            sequence=cloud.sequence,
            points=cloud.channels.view(POINT)[..., 0],
            window_frames=7,
            newest_stamp_ns=cloud.stamp_ns,
            epoch=0,
            pattern_set="interleaved f1=25",
            grid_px=4.0,
            valid_count=int(np.isfinite(cloud.channels[..., 2]).sum()),
        )
        yield message, cloud.T_scene_camera


def test_clouds_that_newer_ones_overtook_are_counted_and_bridged() -> None:
    assert Odometry.newest == (topics.CLOUD,)
    odometry = Odometry(OdometryConfig())
    kept = [(c, T) for c, T in simulated(0.7) if c.sequence < 10 or c.sequence % 4 in (0, 1)]
    poses = [m for cloud, _ in kept for m in odometry.step(cloud) if isinstance(m, Pose)]
    assert {p.state for p in poses} == {Tracking.TRACKING}
    assert trajectory.ate(np.array([p.T_world_camera for p in poses]), np.array([T for _, T in kept])).rms_um < 10.0
    first, last = kept[0][0].sequence, kept[-1][0].sequence
    assert odometry.values()["clouds_skipped"] == last - first + 1 - len(kept) > 40


def test_a_mode_with_a_cloud_every_few_frames_skips_none() -> None:
    odometry = Odometry(OdometryConfig())
    for cloud, _ in simulated(0.2):
        if cloud.sequence % 7 == 0:
            list(odometry.step(cloud))
    assert odometry.values()["clouds_skipped"] == 0
