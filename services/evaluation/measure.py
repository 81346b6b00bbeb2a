"""Virtual runs through the services' own steps: frames to clouds, clouds to a merged map."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from endo3d.schemas.messages import Cloud, Frame, Pose, Truth
from endo3d.services.decoder import Decoder
from endo3d.services.evaluation import prerender
from endo3d.services.evaluation.flat_field import core_map
from endo3d.services.evaluation.virtual_run import VirtualRun
from endo3d.services.odometry import Odometry
from endo3d_core.live_view import LiveView

FIBRE = (
    "The decoder knows the camera fibre: its cores from 16 noisy flat images, its crosstalk as if measured without "
    "error (with 20 % less assumed than there is, the standing cylinder's radius moves by 3 to 6 um)."
)
"""To be said of every experiment through fibres."""
Points = NDArray[np.float64]
Measured = tuple[Cloud, Truth]
"""A cloud with the truth of the frame it belongs to."""


def ignore(done: int) -> None:
    """Progress that nobody watches."""


@dataclass(frozen=True)
class Settings:
    """How an evaluation is to be carried out."""

    folder: Path
    """Reports, plots, and what was measured so far."""
    quick: bool = False
    threads: int = 1
    """That render."""
    frames: Path | None = None
    """Where rendered frames are kept: measuring them again with another decoder needs no rendering."""
    progress: Callable[[int], None] = ignore

    def shots(self, run: VirtualRun) -> Iterable[tuple[Frame, Truth]]:
        """A run's frames, rendered now or earlier."""
        if self.frames is None:
            return run.shots(threads=self.threads)
        path = self.frames / f"{prerender.name(run)}.mcap"
        if not path.exists():
            self.frames.mkdir(parents=True, exist_ok=True)
            prerender.prerender(run, path, self.threads, ignore)
        return prerender.frames_of(path)


class Clouds:
    """The decoder's own steps over the frames of a run."""

    def __init__(self, settings: Settings, run: VirtualRun, calibration_yaml: str) -> None:
        fibre = str(core_map(run.head_yaml, settings.folder)) if run.effects.camera_fibre else ""
        self._decoder = Decoder(Decoder.Config.model_validate({"depth": False, "fibre": fibre}))
        for message in run.calibration(calibration_yaml):
            list(self._decoder.step(message))
        self._truths: dict[int, Truth] = {}

    def of(self, frame: Frame, truth: Truth) -> Iterator[Measured]:
        """The clouds that this frame completes."""
        self._truths[frame.sequence] = truth
        self._truths.pop(frame.sequence - 64, None)
        for message in self._decoder.step(frame):
            if isinstance(message, Cloud):
                yield message, self._truths[message.sequence]


def clouds(settings: Settings, run: VirtualRun, calibration_yaml: str) -> Iterator[Measured]:
    """All clouds of a run."""
    decoding = Clouds(settings, run, calibration_yaml)
    for frame, truth in settings.shots(run):
        yield from decoding.of(frame, truth)


def points_of(cloud: Cloud) -> Points:
    """(n, 3) mm in the camera's axes: what was measured."""
    xyz = cloud.channels[..., :3]
    return np.asarray(xyz[np.isfinite(xyz[..., 2])], np.float64)


def moved(T: NDArray[np.float64], points: Points) -> Points:
    """(n, 3) points into another frame."""
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


@dataclass(frozen=True, eq=False)
class Map:
    """What a hand-guided run left."""

    points: Points
    """(n, 3) mm in the scene's axes, placed by the true pose of the first cloud."""
    counts: NDArray[np.int64]
    """(n,) observations."""
    estimated: NDArray[np.float64]
    """(m, 4, 4) T_scene_camera by odometry."""
    true: NDArray[np.float64]
    """(m, 4, 4)."""
    states: dict[str, int]
    """Clouds per tracking state."""


class Merging:
    """The odometry's own steps over clouds; or, with ``true_poses``, the truth in the registration's place."""

    def __init__(self, merging_distance_um: float, *, true_poses: bool = False) -> None:
        config = Odometry.Config.model_validate({"merging_distance_um": merging_distance_um})
        self._service, self._true_poses = Odometry(config), true_poses
        self._map, self._view = self._service.odometry.map, LiveView()
        self._estimated: list[NDArray[np.float64]] = []
        self._true: list[NDArray[np.float64]] = []
        self._states: dict[str, int] = {}

    def add(self, cloud: Cloud, truth: Truth) -> None:
        """One cloud more."""
        self._true.append(truth.T_scene_camera)
        if self._true_poses:
            T_world_camera = np.linalg.inv(self._true[0]) @ truth.T_scene_camera
            self._view.load(cloud.channels)
            self._map.merge(self._view.live, T_world_camera, cloud.sequence)
            state = "true"
        else:
            pose = next(m for m in self._service.step(cloud) if isinstance(m, Pose))
            T_world_camera, state = pose.T_world_camera, str(pose.state)
        self._estimated.append(T_world_camera)
        self._states[state] = self._states.get(state, 0) + 1

    def map(self, at_least: int) -> Map:
        """What was merged so far; points with ``at_least`` so many observations."""
        points = self._map.points(at_least)
        xyz = np.stack([points[axis] for axis in "xyz"], axis=-1).astype(np.float64)
        T_scene_world = self._true[0]
        return Map(
            moved(T_scene_world, xyz),
            points["count"].astype(np.int64),
            np.stack([T_scene_world @ T for T in self._estimated]),
            np.stack(self._true),
            dict(self._states),
        )
