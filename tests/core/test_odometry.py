"""Odometry on simulated clouds with known poses: analytic surfaces and white noise, no decoder."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from endo3d_core import recovery, rigid, trajectory
from endo3d_core import simulated_clouds as sim
from endo3d_core.merging import MergedMap
from endo3d_core.odometry import Estimate, Odometry, State
from endo3d_core.registration import Linearisation

SMALL = sim.Sensor(width=240, height=160)
"""A coarser grid over the same field: a third of the work."""


def scan(
    odometry: Odometry,
    scene: str,
    duration_s: float = 0.5,
    sensor: sim.Sensor = SMALL,
    keep: slice | list[int] = slice(None),
) -> tuple[list[Estimate], np.ndarray, np.ndarray]:
    """Estimates, estimated poses and true poses of a hand-guided scan."""
    estimates, truth = [], []
    clouds = list(sim.clouds(sim.SCENES[scene](), sim.HandMotion(), duration_s, sensor=sensor))
    for cloud in clouds[keep] if isinstance(keep, slice) else [clouds[k] for k in keep]:
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


@pytest.mark.parametrize("scene", ["contour", "plane"])
def test_a_machine_that_is_too_slow_from_the_first_cloud_on_still_tracks(scene: str) -> None:
    """Six to ten clouds apart a hand moves by a fifth of a millimetre, wherever it likes."""
    odometry, gaps = Odometry(), np.random.default_rng(5).integers(6, 11, 14)
    estimates, poses, truth = scan(odometry, scene, 0.6, keep=list(np.cumsum(gaps)[np.cumsum(gaps) < 103]))
    assert {e.state for e in estimates} <= {State.TRACKING, State.RELOCALISED}
    assert trajectory.ate(poses, truth).rms_um < 20.0
    assert odometry.submap == 0


def test_bursts_of_missing_clouds_in_twice_the_motion_never_mislead() -> None:
    """What is claimed is true: whatever is not lost lies where it says, within its submap."""
    scene, motion = sim.plane(), sim.HandMotion(drift_mm_s=6.0, tremor_mm=0.15)
    odometry, rng = Odometry(), np.random.default_rng(3)
    missing, claimed, T_scene_world = 0, 0, dict[int, np.ndarray]()
    for cloud in sim.clouds(scene, motion, 1.0, sensor=SMALL):
        missing = missing - 1 if missing > 0 else (int(rng.integers(1, 13)) if rng.random() < 0.1 else 0)
        if missing > 0:
            continue
        estimate = odometry.track(cloud.channels, cloud.sequence, cloud.stamp_ns)
        if estimate.state is State.LOST:
            continue
        claimed += 1
        T = T_scene_world.setdefault(estimate.submap, cloud.T_scene_camera @ rigid.inverse(estimate.T_world_camera))
        off = rigid.inverse(cloud.T_scene_camera) @ T @ estimate.T_world_camera
        assert np.linalg.norm(rigid.apply(off, [0.0, 0.0, 20.0]) - (0.0, 0.0, 20.0)) < 0.1
    assert claimed > 60


def jump(scene: str, by_mm: tuple[float, float, float], clouds: int) -> tuple[Odometry, list[Estimate], float]:
    """A hand-guided scan, 0.3 s of nothing, then a still camera elsewhere: odometry, what it said there, error um."""
    odometry, sensor = Odometry(), SMALL
    _, poses, truth = scan(odometry, scene, 0.2)
    there = truth[-1].copy()
    there[:3, 3] += by_mm
    caster, after_ns = sim.Caster(sim.SCENES[scene](), sensor), round(0.5e9)
    estimates = [
        odometry.track(caster.cast(there, 1000 + k), 1000 + k, after_ns + k * 5_800_000) for k in range(clouds)
    ]
    expected = poses[-1] @ np.linalg.inv(truth[-1]) @ there
    return odometry, estimates, float(1e3 * np.linalg.norm(estimates[-1].T_world_camera[:3, 3] - expected[:3, 3]))


@pytest.mark.parametrize("scene", ["contour", "ball"])
def test_a_camera_that_jumped_is_found_within_a_few_clouds(scene: str) -> None:
    odometry, estimates, error_um = jump(scene, (0.9, -0.7, 0.15), clouds=10)
    assert estimates[-1].state == State.TRACKING
    assert {e.state for e in estimates} <= {State.LOST, State.RELOCALISED, State.TRACKING}
    assert error_um < 20.0
    assert odometry.submap == 0


def test_a_camera_that_stays_lost_begins_a_new_submap() -> None:
    odometry, estimates, _ = jump("blade", (9.0, 0.0, 0.0), clouds=32)
    assert {e.state for e in estimates[:25]} == {State.LOST}
    assert not any(e.information.any() for e in estimates[:25])
    assert odometry.submap == 1
    assert estimates[-1].state == State.TRACKING


def test_a_camera_that_comes_back_rejoins_the_submap_it_left() -> None:
    odometry, _, _ = jump("blade", (9.0, 0.0, 0.0), clouds=40)
    assert odometry.submap == 1
    caster, home = sim.Caster(sim.blade(), SMALL), sim.HandMotion().pose(0.1)
    estimates = [odometry.track(caster.cast(home, 2000 + k), 2000 + k, 10**9 + k * 5_800_000) for k in range(90)]
    assert odometry.submap == 0
    back = [e.submap for e in estimates].index(0)
    assert estimates[back].state == State.RELOCALISED
    assert {e.state for e in estimates[back + 1 :]} == {State.TRACKING}
    expected = rigid.inverse(sim.HandMotion().pose(0.0)) @ home
    assert 1e3 * np.linalg.norm(estimates[-1].T_world_camera[:3, 3] - expected[:3, 3]) < 20.0


def test_a_search_does_a_bounded_share_of_its_work_per_cloud(monkeypatch: pytest.MonkeyPatch) -> None:
    rows: list[int] = []
    at = Linearisation.at

    def counting(self: Linearisation, T: np.ndarray, world: MergedMap, chosen: np.ndarray, *rest: Any) -> Any:
        rows.append(len(chosen))
        return at(self, T, world, chosen, *rest)

    monkeypatch.setattr(Linearisation, "at", counting)
    odometry, _, _ = jump("blade", (9.0, 0.0, 0.0), clouds=1)
    for k in range(1, 12):
        rows.clear()
        caster = sim.Caster(sim.blade(), SMALL)
        there = sim.HandMotion().pose(0.0)
        there[0, 3] += 9.0
        assert odometry.track(caster.cast(there, k), 1000 + k, round(0.5e9) + k * 5_800_000).state == State.LOST
        assert sum(rows) <= 3 * 8 * recovery.REGISTERED_POINTS
