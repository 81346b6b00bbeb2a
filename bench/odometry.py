"""Odometry on simulated clouds: time, trajectory, map and features beside the goals, and the lidar baselines.

    python -m bench.odometry                        # all, about a quarter of an hour
    python -m bench.odometry contour scenes weak    # some

Clouds are simulated: 350x220 rays on analytic surfaces, 10 um white noise, 1 % outliers, 15 % texture, a hand's
motion (drift and tremor), 172 Hz. ``decoded`` alone has a decoder before it: frames of the virtual rig.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from endo3d.schemas.messages import Cloud
from endo3d.services.decoder import Decoder, DecoderConfig
from endo3d.services.evaluation.virtual_run import VirtualRun, head_yaml
from endo3d_core import backends, metrology, rigid, trajectory
from endo3d_core import simulated_clouds as sim
from endo3d_core.merging import MAP_POINT
from endo3d_core.odometry import State
from endo3d_core.virtual_rig.effects import PRESETS

LONG = sim.HandMotion(reach_mm=(4.0, 1.0), centre_mm=(1.0, 0.0))
"""Along the whole contour standard and back."""
SHORT_S = 5.0
KISS_MM = (0.15, 0.3, 0.6)
"""kiss-icp's voxels; its other lengths are the best of fifteen settings that were tried."""
RENDERED = ("contour texture=noise:0.15:0.15", "blade texture=noise:0.15", "sphere r=3 at=0,0,21 + plane z=22")


@dataclass
class Run:
    """What a tracker made of a scan."""

    tracker: backends.Tracker
    poses: list[np.ndarray] = field(default_factory=list)
    truth: list[np.ndarray] = field(default_factory=list)
    states: list[State] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)
    submaps: set[int] = field(default_factory=set)
    delta_points: int = 0

    def add(self, channels: np.ndarray, sequence: int, stamp_ns: int, T_scene_camera: np.ndarray) -> None:
        """One cloud more."""
        start = time.thread_time()
        estimate = self.tracker.track(channels, sequence, stamp_ns)
        self.delta_points += len(self.tracker.map.take_delta().points)
        self.cpu_ms.append(1e3 * (time.thread_time() - start))
        self.poses.append(estimate.T_world_camera)
        self.truth.append(T_scene_camera)
        self.states.append(estimate.state)
        self.submaps.add(estimate.submap)

    def lost(self) -> int:
        return sum(state is State.LOST for state in self.states)

    def ate_um(self) -> float:
        known = [k for k, state in enumerate(self.states) if state is not State.LOST]
        return trajectory.ate(np.array(self.poses)[known], np.array(self.truth)[known]).rms_um

    def points(self) -> np.ndarray:
        """Map points seen ten times or more, in the scene's axes."""
        seen = self.tracker.map.points(at_least=10)
        T_scene_world = self.truth[0] @ rigid.inverse(self.poses[0])
        return rigid.apply(T_scene_world, np.stack([seen[axis] for axis in "xyz"], axis=1))


Alter = Callable[[Iterator[sim.SimulatedCloud]], Iterator[sim.SimulatedCloud]]


def run(
    scene: str,
    duration_s: float,
    trackers: dict[str, backends.Tracker],
    motion: sim.HandMotion | None = None,
    sensor: sim.Sensor | None = None,
    alter: Alter = iter,
) -> dict[str, Run]:
    """One scan, each cloud to every tracker; time is the CPU time of this thread, merging and the delta included."""
    done = {name: Run(tracker) for name, tracker in trackers.items()}
    for cloud in alter(sim.clouds(sim.SCENES[scene](), motion or sim.HandMotion(), duration_s, sensor=sensor)):
        for of in done.values():
            of.add(cloud.channels, cloud.sequence, cloud.stamp_ns, cloud.T_scene_camera)
    return done


def ours(scene: str, duration_s: float, **scan: Any) -> Run:
    return run(scene, duration_s, {"projective": backends.make()}, **scan)["projective"]


def contour() -> None:
    """26 s along the contour standard, as the paper's table 5."""
    done = ours("contour", 26.0, motion=LONG)
    steady = np.array(done.cpu_ms[20:])
    show("time per cloud, mean", "5 ms", f"{steady.mean():.2f} ms")
    show("time per cloud, p99", "6 ms", f"{np.percentile(steady, 99):.2f} ms")
    show("contour, 26 s: trajectory", "10 um", f"{done.ate_um():.1f} um")
    rate = done.delta_points / len(done.cpu_ms) * 172.0 * MAP_POINT.itemsize / 1e6
    show("map deltas at 172 Hz", "3 MB/s", f"{rate:.2f} MB/s")
    points = done.points()
    surface = metrology.surface_error(points, sim.SCENES["contour"]().distance)
    show("contour: map to truth, mean / std", "", f"{surface.mean_um:+.2f} / {surface.std_um:.2f} um")
    for name, goal, text in features(points):
        show(name, goal, text)


def features(points: np.ndarray) -> Iterator[tuple[str, str, str]]:
    """Size errors of the standard's features."""
    x, h = points[:, 0], -points[:, 2]

    def flat(low: float, high: float, height: float) -> np.ndarray:
        return points[(x > low) & (x < high) & (np.abs(h - height) < 0.1)]

    for radius, centre, goal in ((1.0, -3.5, "2 um"), (0.5, -1.0, "4 um")):
        angle = np.degrees(np.arctan2(x - centre, h))
        cap = points[(np.hypot(x - centre, h) < 1.3 * radius) & (h > 0.2) & (np.abs(angle) < 50)]
        fit = metrology.fit_cylinder(cap, axis=(0, 1, 0))
        yield f"radius {radius} mm", goal, f"{1e3 * (fit.radius_mm - radius):+.2f} um (form {fit.form_um:.1f})"
    base = metrology.fit_plane(flat(-2.3, -1.7, 0.0))
    top = metrology.fit_plane(flat(0.9, 1.7, 1.0))
    for step, lower, upper in ((1.0, base, flat(0.9, 1.7, 1.0)), (0.5, top, flat(2.4, 3.2, 0.5))):
        height, form_um = metrology.step_height_mm(lower, upper)
        yield f"step {step} mm", "0.5 um", f"{1e3 * (height - step):+.2f} um (form {form_um:.1f})"
    flanks = [points[(np.abs(x - at) < 0.25) & (h > 0.2)] for at in (5.05, 5.95)]
    left, right = (metrology.fit_plane(flank) for flank in flanks)
    angle_deg = metrology.wedge_angle_deg(left, right, inside=(5.5, 0.0, 0.0))
    yield "angle 90 deg", "0.05 deg", f"{angle_deg - 90.0:+.3f} deg"


def scenes() -> None:
    for scene in ("blade", "ball", "plane"):
        done = ours(scene, SHORT_S)
        show(f"{scene}, 5 s: trajectory", "10 um", f"{done.ate_um():.1f} um")
    done = ours("plane", 100 / 172.0)
    points = done.points()
    form_um = 1e3 * metrology.fit_plane(points).distance(points).std()
    show("plane map after 100 clouds, std", "1 um", f"{form_um:.2f} um")


def weak() -> None:
    bare = sim.Sensor(texture=0.0)
    done = ours("contour", SHORT_S, motion=LONG, sensor=bare)
    share = np.mean([state is State.DEGENERATE for state in done.states])
    moved = trajectory.align(np.array(done.poses), np.array(done.truth), "first")
    off_um = 1e3 * (moved[:, :3, 3] - np.array(done.truth)[:, :3, 3])
    rms = np.sqrt((off_um**2).mean(axis=0))
    text = f"x {rms[0]:.1f}, z {rms[2]:.1f} um; {share:.0%} degenerate"
    show("contour without texture: observable axes", "10 um", text)

    def halved(clouds: Iterator[sim.SimulatedCloud]) -> Iterator[sim.SimulatedCloud]:
        return (cloud for cloud in clouds if cloud.sequence % 2 == 0)

    def occluded(clouds: Iterator[sim.SimulatedCloud]) -> Iterator[sim.SimulatedCloud]:
        for cloud in clouds:
            if 1.0 < 1e-9 * cloud.stamp_ns < 1.3:
                cloud.channels[:] = np.nan
            yield cloud

    def bursts(clouds: Iterator[sim.SimulatedCloud]) -> Iterator[sim.SimulatedCloud]:
        """Up to twelve clouds missing at a time, half of all in the end."""
        rng, missing = np.random.default_rng(3), 0
        for cloud in clouds:
            missing = missing - 1 if missing > 0 else (int(rng.integers(1, 13)) if rng.random() < 0.15 else 0)
            if missing == 0:
                yield cloud

    def sparse(clouds: Iterator[sim.SimulatedCloud]) -> Iterator[sim.SimulatedCloud]:
        """One of six to ten, from the first on."""
        chosen = set(np.cumsum(np.random.default_rng(5).integers(6, 11, 100)).tolist())
        return (cloud for cloud in clouds if cloud.sequence in chosen)

    cases = (
        ("every second cloud missing", halved, sim.HandMotion()),
        ("occluded for 0.3 s", occluded, sim.HandMotion()),
        ("bursts missing, twice the motion", bursts, sim.HandMotion(drift_mm_s=6.0, tremor_mm=0.15)),
        ("one cloud of 6 to 10", sparse, sim.HandMotion()),
    )
    for name, alter, motion in cases:
        for scene in sim.SCENES:
            done = ours(scene, 2.0, alter=alter, motion=motion)
            found = f"{done.states.count(State.RELOCALISED)} x relocalised, " if done.lost() else ""
            submaps = f", {len(done.submaps)} submaps" if len(done.submaps) > 1 else ""
            show(f"{scene}: {name}", "tracks", f"{found}{done.ate_um():.1f} um, {done.lost()} lost{submaps}")


def baselines() -> None:
    """The same clouds through the lidar trackers, each cloud to all of them in turn."""
    for scene in sim.SCENES:
        kiss = {f"kiss-icp, {mm} mm": backends.PointTracker(backends.KissIcp(mm), 0.075, 1_000_000) for mm in KISS_MM}
        others = {**kiss, "small_gicp": backends.make("small-gicp")}
        done = run(scene, SHORT_S, {"projective": backends.make(), **others})
        ate_um = {name: of.ate_um() for name, of in done.items()}
        for name, of in done.items():
            show(f"{scene}, 5 s: {name}", "", f"{ate_um[name]:.1f} um, {np.mean(of.cpu_ms[20:]):.1f} ms")
        best_um = min(ate_um[name] for name in kiss)
        show(f"{scene}: best kiss-icp over projective", "100 x", f"{best_um / ate_um['projective']:.0f} x")
        ratio = ate_um["small_gicp"] / ate_um["projective"]
        show(f"{scene}: small_gicp over projective", "", f"{ratio:.0f} x")


def decoded() -> None:
    """Clouds decoded from rendered frames: 960x600 pixels of the virtual rig, its fast preset, 2 s by hand."""
    for scene in RENDERED:
        shown = VirtualRun(head_yaml("base6_wd20"), scene, "hand seed=7", "interleaved f1=25", 172.0, 344,
                           effects=PRESETS["fast"], bin_px=2)  # fmt: skip
        decoder, done, truths = Decoder(DecoderConfig()), Run(backends.make()), dict[int, np.ndarray]()
        for message in (*shown.calibration(), shown.mode()):
            list(decoder.step(message))
        for frame, truth in shown.shots():
            truths[truth.sequence] = truth.T_scene_camera
            for cloud in decoder.step(frame):
                if isinstance(cloud, Cloud):
                    done.add(cloud.channels, cloud.sequence, cloud.stamp_ns, truths[cloud.sequence])
        text = f"{done.ate_um():.1f} um, {done.lost()} of {len(done.states)} lost, {np.mean(done.cpu_ms[20:]):.1f} ms"
        show(f"decoded: {scene}", "10 um", text)


SECTIONS: dict[str, Callable[[], None]] = {
    "contour": contour,
    "scenes": scenes,
    "weak": weak,
    "baselines": baselines,
    "decoded": decoded,
}


def show(figure: str, goal: str, measured: str) -> None:
    print(f"{figure:<52} {goal:<7} {measured}", flush=True)


def main(names: list[str]) -> None:
    print("odometry; times are of one thread's CPU")
    show("", "goal", "measured")
    for name in names or SECTIONS:
        SECTIONS[name]()


if __name__ == "__main__":
    main(sys.argv[1:])
