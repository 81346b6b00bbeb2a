"""Loops on simulated clouds: a head that comes back, and one that does not; and what moves a map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from endo3d_core import map_rows, metrology, rigid, trajectory
from endo3d_core import simulated_clouds as sim
from endo3d_core.keyframes import Keyframes
from endo3d_core.loop_closure import LoopClosing
from endo3d_core.merging import FIRST, LAST, MergedMap
from endo3d_core.odometry import State

SMALL = sim.Sensor(width=120, height=80, field_mm=6.0)
"""Half the field, so that a small circle leaves it."""
RATE_HZ = 172.0


@dataclass(frozen=True)
class Round:
    """Once around a circle of ``radius_mm`` in ``period_s``, and on."""

    radius_mm: float = 3.5
    period_s: float = 3.0

    def pose(self, t_s: float) -> np.ndarray:
        T, angle = sim.HandMotion(reach_mm=(0.0, 0.0), drift_mm_s=1.0).pose(t_s), 2 * np.pi * t_s / self.period_s
        T[:2, 3] += self.radius_mm * np.cos(angle), self.radius_mm * np.sin(angle)
        return T


@dataclass
class Scan:
    """What a tracker made of the blade."""

    tracker: LoopClosing
    truth: np.ndarray
    tracked: np.ndarray
    published: np.ndarray
    states: set[State]
    corrections: list[int]
    """Of every cloud: how many there were."""

    def corrected(self) -> np.ndarray:
        return self.tracker.trajectory()["T"]

    def surface(self, world: MergedMap | None = None) -> metrology.SurfaceError:
        points = (world or self.tracker.map).points()
        T_scene_world = self.truth[0] @ rigid.inverse(self.tracked[0])
        xyz = rigid.apply(T_scene_world, np.stack([points[axis] for axis in "xyz"], axis=1))
        return metrology.surface_error(xyz, sim.blade().distance)


def scan(motion: Any, duration_s: float, tracker: LoopClosing | None = None) -> Scan:
    tracker = tracker or LoopClosing()
    truth, tracked, published, states, corrections = [], [], [], set(), []
    for cloud in sim.clouds(sim.blade(), motion, duration_s, rate_hz=RATE_HZ, sensor=SMALL):
        T_world_odom = tracker.T_world_odom
        estimate = tracker.track(cloud.channels, cloud.sequence, cloud.stamp_ns)
        truth.append(cloud.T_scene_camera)
        tracked.append(rigid.inverse(T_world_odom) @ estimate.T_world_camera)
        published.append(estimate.T_world_camera)
        states.add(estimate.state)
        corrections.append(tracker.correction.number if tracker.correction else 0)
    return Scan(tracker, np.array(truth), np.array(tracked), np.array(published), states, corrections)


def test_the_real_odometry_gains_or_keeps_what_it_has() -> None:
    done = scan(Round(), 3.7)
    assert done.tracker.loops >= 1
    before = trajectory.ate(done.tracked, done.truth, "first").rms_um
    after = trajectory.ate(done.corrected(), done.truth, "first").rms_um
    assert after < max(1.1 * before, 10.0)
    assert done.surface().std_um < 10.0


def test_a_way_that_does_not_come_back_is_left_alone() -> None:
    done = scan(Round(radius_mm=6.0, period_s=5.0), 1.2)
    assert len(done.tracker.keyframes) > 4
    assert done.tracker.loops == 0
    assert done.tracker.correction is None
    np.testing.assert_array_equal(done.tracked, done.published)


def textured_map(clouds: int = 12) -> MergedMap:
    tracker = LoopClosing()
    for cloud in sim.clouds(sim.blade(), sim.HandMotion(), clouds / RATE_HZ, rate_hz=RATE_HZ, sensor=SMALL):
        tracker.track(cloud.channels, cloud.sequence, cloud.stamp_ns)
    return tracker.map


def by_key(points: np.ndarray) -> np.ndarray:
    return points[np.lexsort((points["kz"], points["ky"], points["kx"]))]


def test_a_map_put_together_from_its_rows_is_the_map() -> None:
    world = textured_map()
    again = MergedMap(world.merging_distance_mm, 100_000)
    rows = map_rows.finished(world)
    for part in np.array_split(rows, 7):
        map_rows.absorb(again, part)
    a, b = by_key(world.points()), by_key(again.points())
    assert len(a) == len(b)
    for name in ("x", "y", "z", "nx", "intensity", "sigma"):
        np.testing.assert_allclose(a[name], b[name], rtol=1e-5, atol=1e-6)
    assert np.array_equal(a["count"], b["count"])
    assert len(again.take_delta().points) == len(b)


def test_a_point_absorbed_twice_counts_twice_and_stays() -> None:
    world = textured_map()
    again = MergedMap(world.merging_distance_mm, 100_000)
    rows = map_rows.finished(world)
    map_rows.absorb(again, rows)
    map_rows.absorb(again, rows)
    a, b = by_key(world.points()), by_key(again.points())
    assert np.array_equal(2 * a["count"], b["count"])
    np.testing.assert_allclose(a["z"], b["z"], atol=1e-5)
    np.testing.assert_allclose(a["sigma"], b["sigma"], rtol=1e-4, atol=1e-6)


def test_what_is_retired_is_gone_from_the_map_and_complete() -> None:
    world = textured_map()
    world.ints[: world.used : 3, LAST] = -5
    old = np.flatnonzero((world.ints[: world.used, LAST] == -5) & (world.ints[: world.used, 13] >= 8))
    expected, before = world.rows[old].copy(), world.count
    retirement, taken = map_rows.Retirement(world, 1000), []
    for _ in range(world.used // 1000 + 1):
        taken.append(retirement.take(0))
    rows = np.concatenate(taken)
    assert np.array_equal(np.sort(rows[:, 0]), np.sort(expected[:, 0]))
    assert world.count <= before - len(old)
    assert not len(retirement.take(0))
    assert (world.ints[world.confirmed(), LAST] != -5).all()


def test_points_and_poses_between_keyframes_move_alike() -> None:
    """A point held by the camera at some time stays where the camera sees it."""
    kept = Keyframes(1000)
    for k in range(4):
        kept.add(10 * k, k, rigid.translation([2.0 * k, 0, 0]), np.array([2.0 * k, 0, 20]), np.eye(6), True)
    kept.graph.poses = np.array(kept.T_odom_camera) @ np.array(
        [rigid.exp([0.01 * k, 0.02 * k, 0, 0, 0.0005 * k, 0]) for k in range(4)]
    )
    T = np.array([rigid.translation([0.2 * s, 0, 0]) for s in range(30)])
    rows = np.zeros((30, 16), np.float32)
    rows[:, :3] = rigid.apply(np.eye(4), T[:, :3, 3] + [0.5, 0.2, 20.0])
    rows.view(np.int32)[:, FIRST] = rows.view(np.int32)[:, LAST] = np.arange(30)
    kept.keep(rows)
    assert kept.points == 30
    moved = kept.warped(rows)[:, :3]
    corrected = kept.corrected(np.arange(30), T)
    seen = np.einsum("kij,j->ki", corrected[:, :3, :3], [0.5, 0.2, 20.0]) + corrected[:, :3, 3]
    np.testing.assert_allclose(moved, seen, atol=2e-5)
    np.testing.assert_allclose(corrected[20], kept.graph.poses[2], atol=1e-9)


def test_what_does_not_fit_is_counted() -> None:
    kept = Keyframes(20)
    kept.add(0, 0, np.eye(4), np.zeros(3), np.eye(6), True)
    kept.keep(np.zeros((30, 16), np.float32))
    assert (kept.points, kept.refused) == (20, 10)
