"""Virtual runs through the services' own steps: frames to clouds, clouds to a merged map."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from endo3d.schemas.messages import Cloud, Pose, Truth
from endo3d.services.decoder import Decoder
from endo3d.services.evaluation.virtual_run import VirtualRun
from endo3d.services.odometry import Odometry

Points = NDArray[np.float64]
Progress = Callable[[int], None]


def clouds(
    run: VirtualRun, calibration_yaml: str | None = None, threads: int = 1, progress: Progress | None = None
) -> Iterator[tuple[Cloud, Truth]]:
    """Each cloud with the truth of the frame it belongs to."""
    decoder = Decoder(Decoder.Config(depth=False))
    for message in run.calibration(calibration_yaml):
        list(decoder.step(message))
    truths: dict[int, Truth] = {}
    for frame, truth in run.shots(threads=threads):
        truths[frame.sequence] = truth
        truths.pop(frame.sequence - 64, None)
        for message in decoder.step(frame):
            if isinstance(message, Cloud):
                yield message, truths[message.sequence]
        if progress is not None:
            progress(frame.sequence + 1)


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


def merged(
    measured: Iterable[tuple[Cloud, Truth]],
    merging_distance_um: float,
    *,
    at_least: int,
    true_poses: bool = False,
) -> Map:
    """Register and merge; points with ``at_least`` so many observations stay.

    With ``true_poses`` the truth takes the registration's place: what is left is not its share.
    """
    service = Odometry(Odometry.Config.model_validate({"merging_distance_um": merging_distance_um}))
    odometry = service.odometry
    estimated: list[NDArray[np.float64]] = []
    true: list[NDArray[np.float64]] = []
    states: dict[str, int] = {}
    for cloud, truth in measured:
        if true_poses:
            T_scene_camera = truth.T_scene_camera
            T_world_camera = np.linalg.inv(true[0]) @ T_scene_camera if true else np.eye(4)
            odometry.view.load(cloud.channels)
            odometry.map.merge(odometry.view.live, T_world_camera, cloud.sequence)
            state = "true"
        else:
            pose = next(m for m in service.step(cloud) if isinstance(m, Pose))
            T_world_camera, state = pose.T_world_camera, str(pose.state)
        estimated.append(T_world_camera)
        true.append(truth.T_scene_camera)
        states[state] = states.get(state, 0) + 1
    points = odometry.map.points(at_least)
    xyz = np.stack([points[axis] for axis in "xyz"], axis=-1).astype(np.float64)
    T_scene_world = true[0]
    return Map(
        moved(T_scene_world, xyz),
        points["count"].astype(np.int64),
        np.stack([T_scene_world @ T for T in estimated]),
        np.stack(true),
        states,
    )
