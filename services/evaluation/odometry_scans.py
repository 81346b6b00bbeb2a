"""Scans that odometry is judged on, and what a tracker makes of them: errors against the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d_core import backends, metrology, rigid, trajectory
from endo3d_core import simulated_clouds as sim
from endo3d_core.odometry import State

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class TrueCloud:
    """An organised cloud and where it was taken."""

    sequence: int
    stamp_ns: int
    channels: NDArray[np.float32]
    T_scene_camera: Array


@dataclass(frozen=True)
class Round:
    """A hand that goes once around a circle and on: what it saw first comes back."""

    radius_mm: float = 7.0
    period_s: float = 6.0

    def pose(self, t_s: float) -> Array:
        """T_scene_camera (4, 4)."""
        T = sim.HandMotion(reach_mm=(0.0, 0.0), drift_mm_s=1.0).pose(t_s)
        angle = 2.0 * np.pi * t_s / self.period_s
        T[:2, 3] += self.radius_mm * np.cos(angle), self.radius_mm * np.sin(angle)
        return T


@dataclass
class Outcome:
    """What a tracker said, cloud by cloud."""

    tracker: backends.Tracker
    distance: Callable[[Array], Array]
    """Signed distance (n,) mm of scene points (n, 3) to the true surface."""
    poses: list[Array] = field(default_factory=list)
    truth: list[Array] = field(default_factory=list)
    states: list[State] = field(default_factory=list)
    delta_points: int = 0

    def _known(self) -> tuple[Array, Array]:
        known = [k for k, state in enumerate(self.states) if state is not State.LOST]
        return np.array(self.poses)[known], np.array(self.truth)[known]

    def ate(self) -> trajectory.TrajectoryError:
        return trajectory.ate(*self._known())

    def rpe(self, step: int) -> trajectory.TrajectoryError:
        return trajectory.rpe(np.array(self.poses), np.array(self.truth), step)

    def off_um(self) -> Array:
        """(n, 3) errors of the position along the scene's axes, the first poses on top of each other."""
        laid = trajectory.align(np.array(self.poses), np.array(self.truth), "first")
        return np.asarray(1e3 * (laid[:, :3, 3] - np.array(self.truth)[:, :3, 3]))

    def points(self, at_least: int = 10) -> Array:
        """(n, 3) map points in the scene's axes, placed by the true pose of the first cloud."""
        seen = self.tracker.map.points(at_least)
        T_scene_world = self.truth[0] @ rigid.inverse(self.poses[0])
        return rigid.apply(T_scene_world, np.stack([seen[axis] for axis in "xyz"], axis=1))

    def surface(self) -> metrology.SurfaceError:
        return metrology.surface_error(self.points(), self.distance)

    def states_text(self) -> str:
        counts = {state.value: self.states.count(state) for state in State if state in self.states}
        return ", ".join(f"{state} {count}" for state, count in counts.items())

    def figures(self) -> dict[str, Any]:
        """Machine-readable."""
        ate, surface, steps = self.ate(), self.surface(), (1, min(172, len(self.poses) - 1))
        return {
            "clouds": len(self.poses),
            "ate_um": ate.rms_um,
            "ate_max_um": ate.max_um,
            "ate_mrad": ate.rms_mrad,
            "rpe_cloud_um": self.rpe(steps[0]).rms_um,
            "rpe_second_um": self.rpe(steps[1]).rms_um,
            "surface_std_um": surface.std_um,
            "surface_p95_um": surface.p95_um,
            "states": self.states_text(),
            "map_points": surface.count,
        }


def track(
    clouds: Iterable[TrueCloud],
    distance: Callable[[Array], Array],
    tracker: backends.Tracker,
    after: Callable[[TrueCloud, Outcome], None] | None = None,
) -> Outcome:
    """Cloud by cloud through a tracker; ``after`` each it is called with what there is so far."""
    done = Outcome(tracker, distance)
    for cloud in clouds:
        estimate = tracker.track(cloud.channels, cloud.sequence, cloud.stamp_ns)
        done.delta_points += len(tracker.map.take_delta().points)
        done.poses.append(estimate.T_world_camera)
        done.truth.append(cloud.T_scene_camera)
        done.states.append(estimate.state)
        if after is not None:
            after(cloud, done)
    return done


def simulated(
    scene: sim.Scene, motion: Any, duration_s: float, sensor: sim.Sensor | None = None
) -> Iterator[TrueCloud]:
    """Analytic surfaces and white noise, no decoder."""
    for cloud in sim.clouds(scene, motion, duration_s, sensor=sensor):
        yield TrueCloud(cloud.sequence, cloud.stamp_ns, cloud.channels, cloud.T_scene_camera)


def halved(clouds: Iterable[TrueCloud]) -> Iterator[TrueCloud]:
    """Every second cloud is missing."""
    return (cloud for cloud in clouds if cloud.sequence % 2 == 0)


def occluded(clouds: Iterable[TrueCloud], from_s: float, to_s: float) -> Iterator[TrueCloud]:
    """Nothing is seen for a while."""
    first_ns: int | None = None
    for cloud in clouds:
        first_ns = cloud.stamp_ns if first_ns is None else first_ns
        channels = cloud.channels.copy()
        if from_s < 1e-9 * (cloud.stamp_ns - first_ns) < to_s:
            channels[:] = np.nan
        yield TrueCloud(cloud.sequence, cloud.stamp_ns, channels, cloud.T_scene_camera)


def relief_mesh(height: Callable[[Array, Array], Array], half_mm: tuple[float, float], step_mm: float) -> Any:
    """Vertices (n, 3) and faces (m, 3) of z = -height(x, y), its outside towards -z: a scene as a CAD model."""
    x, y = (np.arange(-half, half + step_mm / 2, step_mm) for half in half_mm)
    X, Y = np.meshgrid(x, y)
    vertices = np.stack([X, Y, -height(X, Y)], axis=-1).reshape(-1, 3)
    a = (np.arange(len(y) - 1)[:, None] * len(x) + np.arange(len(x) - 1)).ravel()
    b, c, d = a + 1, a + len(x), a + len(x) + 1
    return vertices, np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])
