"""Odometry on simulated clouds: time, trajectory, map and features beside the goals, and the lidar baselines.

    python -m bench.odometry                        # all, about ten minutes
    python -m bench.odometry contour scenes weak    # some

Clouds are simulated: 350x220 rays on analytic surfaces, 10 um white noise, 1 % outliers, 15 % texture, a hand's
motion (drift and tremor), 172 Hz. There is no decoder here; ``endo3d evaluate handheld`` has it.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from rich.console import Console
from rich.table import Table

from endo3d_core import backends, metrology, rigid, trajectory
from endo3d_core import simulated_clouds as sim
from endo3d_core.merging import MAP_POINT
from endo3d_core.odometry import State

LONG = sim.HandMotion(reach_mm=(4.0, 1.0), centre_mm=(1.0, 0.0))
"""Along the whole contour standard and back."""
SHORT_S = 5.0


@dataclass
class Run:
    """What a tracker made of a scan."""

    scene: sim.Scene
    tracker: backends.Tracker
    poses: list[np.ndarray] = field(default_factory=list)
    truth: list[np.ndarray] = field(default_factory=list)
    states: list[State] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)
    delta_points: int = 0

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
    tracker: backends.Tracker,
    motion: sim.HandMotion | None = None,
    sensor: sim.Sensor | None = None,
    alter: Alter = iter,
) -> Run:
    """One scan; time is the CPU time of this thread, merging and the delta included."""
    done = Run(sim.SCENES[scene](), tracker)
    for cloud in alter(sim.clouds(done.scene, motion or sim.HandMotion(), duration_s, sensor=sensor)):
        start = time.thread_time()
        estimate = tracker.track(cloud.channels, cloud.sequence, cloud.stamp_ns)
        done.delta_points += len(tracker.map.take_delta().points)
        done.cpu_ms.append(1e3 * (time.thread_time() - start))
        done.poses.append(estimate.T_world_camera)
        done.truth.append(cloud.T_scene_camera)
        done.states.append(estimate.state)
    return done


def contour(table: Table) -> None:
    """26 s along the contour standard, as the paper's table 5."""
    done = run("contour", 26.0, backends.make(), LONG)
    steady = np.array(done.cpu_ms[20:])
    table.add_row("time per cloud, mean", "5 ms", f"{steady.mean():.2f} ms")
    table.add_row("time per cloud, p99", "6 ms", f"{np.percentile(steady, 99):.2f} ms")
    table.add_row("contour, 26 s: trajectory", "10 um", f"{done.ate_um():.1f} um")
    rate = done.delta_points / len(done.cpu_ms) * 172.0 * MAP_POINT.itemsize / 1e6
    table.add_row("map deltas at 172 Hz", "3 MB/s", f"{rate:.2f} MB/s")
    points = done.points()
    surface = metrology.surface_error(points, done.scene.distance)
    table.add_row("contour: map to truth, mean / std", "", f"{surface.mean_um:+.2f} / {surface.std_um:.2f} um")
    for name, goal, text in features(points):
        table.add_row(name, goal, text)


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


def scenes(table: Table) -> None:
    for scene in ("blade", "ball", "plane"):
        done = run(scene, SHORT_S, backends.make())
        table.add_row(f"{scene}, 5 s: trajectory", "10 um", f"{done.ate_um():.1f} um")
    done = run("plane", 100 / 172.0, backends.make())
    points = done.points()
    form_um = 1e3 * metrology.fit_plane(points).distance(points).std()
    table.add_row("plane map after 100 clouds, std", "1 um", f"{form_um:.2f} um")


def weak(table: Table) -> None:
    bare = sim.Sensor(texture=0.0)
    done = run("contour", SHORT_S, backends.make(), LONG, bare)
    share = np.mean([state is State.DEGENERATE for state in done.states])
    moved = trajectory.align(np.array(done.poses), np.array(done.truth), "first")
    off_um = 1e3 * (moved[:, :3, 3] - np.array(done.truth)[:, :3, 3])
    rms = np.sqrt((off_um**2).mean(axis=0))
    text = f"x {rms[0]:.1f}, z {rms[2]:.1f} um; {share:.0%} degenerate"
    table.add_row("contour without texture: observable axes", "10 um", text)

    def halved(clouds: Iterator[sim.SimulatedCloud]) -> Iterator[sim.SimulatedCloud]:
        return (cloud for cloud in clouds if cloud.sequence % 2 == 0)

    def occluded(clouds: Iterator[sim.SimulatedCloud]) -> Iterator[sim.SimulatedCloud]:
        for cloud in clouds:
            if 1.0 < 1e-9 * cloud.stamp_ns < 1.3:
                cloud.channels[:] = np.nan
            yield cloud

    for name, alter in (("every second cloud missing", halved), ("occluded for 0.3 s", occluded)):
        for scene in ("contour", "blade", "ball", "plane"):
            done = run(scene, 2.0, backends.make(), alter=alter)
            found = "relocalised, " if State.RELOCALISED in done.states else ""
            unknown = sum(state is State.LOST for state in done.states)
            table.add_row(f"{scene}: {name}", "tracks", f"{found}{done.ate_um():.1f} um, {unknown} lost")


def baselines(table: Table) -> None:
    """The same clouds through the lidar trackers."""
    for scene in sim.SCENES:
        ours = run(scene, SHORT_S, backends.make())
        table.add_row(f"{scene}, 5 s: projective", "", _cost(ours))
        errors = []
        for voxel_mm in (0.15, 0.3, 0.6):
            kiss = backends.PointTracker(backends.KissIcp(voxel_mm), 0.075, 1_000_000)
            done = run(scene, SHORT_S, kiss)
            errors.append(done.ate_um())
            table.add_row(f"{scene}, 5 s: kiss-icp, {voxel_mm} mm voxels", "", _cost(done))
        table.add_row(f"{scene}: best kiss-icp over projective", "100 x", f"{min(errors) / ours.ate_um():.0f} x")
        table.add_row(f"{scene}, 5 s: small_gicp", "", _cost(run(scene, SHORT_S, backends.make("small-gicp"))))


def _cost(done: Run) -> str:
    return f"{done.ate_um():.1f} um, {np.mean(done.cpu_ms[20:]):.1f} ms"


SECTIONS: dict[str, Callable[[Table], None]] = {
    "contour": contour,
    "scenes": scenes,
    "weak": weak,
    "baselines": baselines,
}


def main(names: list[str]) -> None:
    table = Table(title="odometry, simulated clouds, CPU time of one thread")
    for column in ("figure", "goal", "measured"):
        table.add_column(column)
    for name in names or SECTIONS:
        SECTIONS[name](table)
    Console(width=110).print(table)


if __name__ == "__main__":
    main(sys.argv[1:])
