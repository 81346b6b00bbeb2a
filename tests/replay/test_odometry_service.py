"""The odometry service on simulated clouds: what it says about clouds that it did not get."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from endo3d.schemas import topics
from endo3d.schemas.messages import POINT, Cloud, MapDelta, Pose, Tracking
from endo3d.services.odometry import Odometry, OdometryConfig
from endo3d_core import simulated_clouds as sim
from endo3d_core import trajectory

SMALL = sim.Sensor(width=240, height=160)


def simulated(duration_s: float, motion: sim.HandMotion | None = None) -> Iterator[tuple[Cloud, np.ndarray]]:
    """Clouds of a hand-guided scan and their true poses."""
    for cloud in sim.clouds(sim.contour_standard(), motion or sim.HandMotion(), duration_s, sensor=SMALL):
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


def test_a_new_submap_begins_a_new_world_for_who_reads_the_map() -> None:
    odometry, told, told_at = Odometry(OdometryConfig()), [], 0
    clouds = [cloud for cloud, _ in simulated(0.4)]
    elsewhere = sim.Caster(sim.blade(), SMALL)
    for k, cloud in enumerate(clouds):
        if k >= 20:  # as if the tip had been moved to another part, in the dark
            points = elsewhere.cast(sim.HandMotion().pose(0.0), k).view(POINT)[..., 0]
            cloud = replace(cloud, points=points, stamp_ns=cloud.stamp_ns + 400_000_000)
        told += list(odometry.step(cloud))
        told_at = told_at or (len(told) if odometry.odometry.submap == 1 else 0)
    assert told_at
    poses = [m for m in told[:told_at] if isinstance(m, Pose)]
    assert [p.submap for p in poses] == [0] * (len(poses) - 1) + [1]
    assert {p.state for p in poses[21:-1]} == {Tracking.LOST}
    maps = [m for m in told[:told_at] if isinstance(m, MapDelta)]
    afresh = [m for m in maps[1:] if m.reset]
    assert len(afresh) == 1
    assert len(afresh[0].points) == 0


def test_a_map_that_fills_up_says_so_before_it_forgets() -> None:
    odometry = Odometry(OdometryConfig(map_limit=10_000))
    world = odometry.odometry.map
    told_at = 0
    for cloud, _ in simulated(0.6, sim.HandMotion(drift_mm_s=12.0)):
        list(odometry.step(cloud))
        assert bool(odometry.trouble()) == (world.count >= 9_000)
        told_at = told_at or (world.count if odometry.trouble() else 0)
        assert world.count <= 10_000
    assert 9_000 <= told_at < 9_500, "at 9500 the oldest points begin to go"
    assert "raise map_limit" in odometry.trouble()
