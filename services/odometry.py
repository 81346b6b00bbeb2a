"""Clouds in; the tip's pose, its health and the merged map out, at camera rate.

On a machine that is too slow for that, live, it takes the newest cloud each time: a pose is never late, and the
prediction spans the true time between stamps. A replay takes every cloud.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from endo3d.schemas import topics
from endo3d.schemas.messages import (
    Cloud,
    Fit,
    MapDelta,
    Message,
    PartPose,
    Pose,
    ProjectorCalibration,
    Tracking,
    Transform,
)
from endo3d.services.exchange.mesh import load_mesh
from endo3d.services.runtime.service import Config, Refused, Service
from endo3d.services.views.colouring import visible
from endo3d_core import backends, merging, odometry, rigid, trajectory
from endo3d_core.loop_closure import LoopClosing
from endo3d_core.odometry import Estimate, State
from endo3d_core.part_registration import Part, PartRegistration, visible_points
from endo3d_core.registration import visible_surface

SHOWN_RELIEF_MM = 3.0
"""Heights that the colours of the published map tell apart, around the first points' median."""


class OdometryConfig(Config):
    backend: backends.Backend = "projective"
    """How clouds are registered; kiss-icp and small-gicp are baselines made for lidar."""
    merging_distance_um: float = Field(75.0, ge=10.0, le=1000.0)
    """Points nearer than this become one (section 3.3); it limits the lateral resolution."""
    map_limit: int = Field(1_000_000, ge=10_000)
    """Map points that are kept at most; each takes about 120 bytes."""
    loop_closure: bool = False
    """Recognise places seen before and put path and map right (costs about one more merge per cloud)."""
    model: str = ""
    """STL or PLY file of the part, in mm: ``part_pose`` then says where the tip is in its coordinates."""
    model_pose: tuple[float, float, float, float, float, float] | None = None
    """Of the first camera in the part: x y z mm, rotation vector deg. Without it the part is searched for."""
    model_every: int = Field(8, ge=1)
    """Clouds from one look at the model to the next."""
    map_hz: float = Field(30.0, gt=0.0, le=topics.MAP.rate_hz)
    """How often changes of the map are published, at most."""


class Odometry(Service[OdometryConfig]):
    """Registers every cloud to the map it is then merged into."""

    Config = OdometryConfig
    reads = (topics.CLOUD, topics.PROJECTOR)
    optional = (topics.PROJECTOR,)
    newest = (topics.CLOUD,)
    writes = (topics.POSE, topics.TRANSFORM, topics.MAP, topics.PART_POSE)
    commands = ("reset", "snapshot", "trajectory")
    nice = 5
    """It may skip clouds; decoder and recorder may not skip frames."""

    def __init__(self, config: OdometryConfig) -> None:
        super().__init__(config)
        self.odometry = self._fresh()
        self._revision = 0
        self._shown: merging.MergedMap | None = None
        self._part: PartRegistration | None = None
        self._looks = 0
        self._relief_mm: tuple[float, float] | None = None
        self._next_map_ns = 0
        self._sequence: int | None = None
        self._stride = 0
        self._skipped = 0
        self._submap = 0
        self._states: dict[str, int] = dict.fromkeys(Tracking, 0)

    def warm(self) -> None:
        """Compile every kernel on a textured plane, in an odometry of its own: twice as far, it is searched for."""
        trial = odometry.Odometry(capacity=100_000)
        plane = _textured_plane()
        for sequence in range(merging.CONFIRMED + 1):
            trial.track(plane, sequence, sequence)
        plane[..., :3] *= 2.0
        trial.track(plane, sequence + 1, sequence + 1)
        trial.map.take_delta()

    def step(self, message: Message) -> Iterator[Message]:
        match message:
            case Cloud():
                yield from self._track(message)
            case ProjectorCalibration():
                yield Transform(message.stamp_ns, "camera", message.frame_id, rigid.inverse(message.T_projector_camera))

    def command(self, verb: str, parameters: Mapping[str, Any], now_ns: int) -> Iterator[Message | Mapping[str, Any]]:
        """``reset`` empties the map, the next cloud is the world; ``snapshot`` publishes the whole map.

        ``trajectory`` replies the corrected path as TUM and CSV text (with ``loop_closure``).
        """
        match verb:
            case "reset":
                self.odometry.reset()
                if self._part is not None:
                    self._part.reset()
            case "snapshot":
                pass
            case "trajectory":
                yield self._trajectory()
                return
            case _:
                raise Refused(f"no command {verb!r}; odometry knows: {', '.join(self.commands)}")
        whole = self._whole_map(now_ns)
        yield whole
        yield {"points": len(whole.points), "revision": self._revision}

    def values(self) -> Mapping[str, float]:
        """Map points, loops, clouds that newer ones overtook (or were not decoded), and clouds in each state."""
        loops = {"loops": self.odometry.loops} if isinstance(self.odometry, LoopClosing) else {}
        return {"map_points": self.odometry.map.count, "clouds_skipped": self._skipped, **loops, **self._states}

    def trouble(self) -> str:
        share = self.odometry.map.count / self.config.map_limit
        if share < 0.9:
            return ""
        return f"the map is {share:.0%} full; it will forget what it saw longest ago: raise map_limit or reset it"

    def open(self) -> None:
        """Raises ``UserError`` when the model can't be read: better now than at the first cloud."""
        if self.config.model:
            load_mesh(self.config.model)

    def _fresh(self) -> backends.Tracker:
        return backends.make(
            self.config.backend,
            1e-3 * self.config.merging_distance_um,
            self.config.map_limit,
            loop_closure=self.config.loop_closure,
        )

    def _trajectory(self) -> Mapping[str, Any]:
        if not isinstance(self.odometry, LoopClosing):
            raise Refused("there is no corrected path without loop_closure = true; the log has the poses")
        path = self.odometry.trajectory()
        known = path[path["state"] != Tracking.LOST]
        csv = trajectory.to_csv(
            path["stamp_ns"].tolist(), path["T"], path["information"], 1e3 * path["sigma_weak_mm"], path["state"]
        )
        tum = trajectory.to_tum(known["stamp_ns"].tolist(), known["T"])
        return {"poses": len(path), "loops": self.odometry.loops, "tum": tum, "csv": csv}

    def _on_part(self, cloud: Cloud, estimate: Estimate) -> Iterator[Message]:
        """Where the tip is in the part's coordinates: by a look at the model now and then, by odometry in between."""
        if estimate.state is State.LOST or not self.config.model:
            return
        frame = visible_surface(self.odometry.view.live)
        if self._part is None:
            self._part = PartRegistration(Part(*load_mesh(self.config.model)), frame.radius_mm, self._given_pose())
        if self._looks % self.config.model_every == 0:
            self._part.look(*visible_points(self.odometry.map), estimate.T_world_camera, frame)
        self._looks += 1
        found = self._part.estimate
        yield PartPose(
            stamp_ns=cloud.stamp_ns,
            sequence=cloud.sequence,
            T_part_camera=rigid.orthonormal(found.T_part_world @ estimate.T_world_camera),
            information=found.information,
            state=Fit(found.state),
            tracking=Tracking(estimate.state),
            sigma_weak_um=1e3 * found.sigma_weak_mm,
            weak_direction=found.weak_direction,
            inlier_share=found.inlier_share,
            residual_um=1e3 * found.residual_mm,
            model=Path(self.config.model).name,
        )

    def _given_pose(self) -> NDArray[np.float64] | None:
        if self.config.model_pose is None:
            return None
        x, y, z, *turn_deg = self.config.model_pose
        T = rigid.translation((x, y, z))
        T[:3, :3] = rigid.rotation_exp(np.radians(turn_deg))
        return T

    def _track(self, cloud: Cloud) -> Iterator[Message]:
        self._count_skipped(cloud.sequence)
        estimate = self.odometry.track(cloud.channels, cloud.sequence, cloud.stamp_ns)
        self._states[estimate.state] += 1
        if estimate.submap != self._submap:  # another world, or back in an older one
            self._submap = estimate.submap
            yield self._whole_map(cloud.stamp_ns)
        yield Pose(
            stamp_ns=cloud.stamp_ns,
            sequence=cloud.sequence,
            T_world_camera=estimate.T_world_camera,
            information=estimate.information,
            state=Tracking(estimate.state),
            sigma_weak_um=1e3 * estimate.sigma_weak_mm,
            weak_direction=estimate.weak_direction,
            inlier_share=estimate.inlier_share,
            residual_um=1e3 * estimate.residual_mm,
            photometric_share=estimate.photometric_share,
            submap=estimate.submap,
            newest_stamp_ns=cloud.newest_stamp_ns,
        )
        yield Transform(cloud.stamp_ns, "world", cloud.frame_id, estimate.T_world_camera)
        yield from self._on_part(cloud, estimate)
        if cloud.stamp_ns >= self._next_map_ns:
            self._next_map_ns = cloud.stamp_ns + round(1e9 / self.config.map_hz)
            # After a correction it is another map, which fills while it is being rebuilt.
            fresh, self._shown = self.odometry.map is not self._shown, self.odometry.map
            yield self._map_delta(self.odometry.map.take_delta(), cloud.stamp_ns, reset=fresh)

    def _count_skipped(self, sequence: int) -> None:
        """By gaps in the sequence, in the shortest step between clouds: not every mode has a cloud for every frame."""
        step = 0 if self._sequence is None else sequence - self._sequence
        self._sequence = sequence
        if step > 0:
            self._stride = min(self._stride or step, step)
            self._skipped += step // self._stride - 1

    def _whole_map(self, stamp_ns: int) -> MapDelta:
        self.odometry.map.take_delta()
        delta = merging.Delta(self.odometry.map.points(), np.empty((0, 3), np.int16))
        return self._map_delta(delta, stamp_ns, reset=True)

    def _map_delta(self, delta: merging.Delta, stamp_ns: int, *, reset: bool) -> MapDelta:
        self._revision += 1
        if self._relief_mm is None and len(delta.points):
            middle_mm = -float(np.median(delta.points["z"]))
            self._relief_mm = (middle_mm - SHOWN_RELIEF_MM / 2, middle_mm + SHOWN_RELIEF_MM / 2)
        return MapDelta(
            stamp_ns=stamp_ns,
            sequence=self._sequence or 0,
            points=visible(delta.points, *(self._relief_mm or (0.0, 1.0))),
            removed=delta.removed,
            revision=self._revision,
            reset=reset,
            map_points=self.odometry.map.count,
            merging_distance_mm=self.odometry.map.merging_distance_mm,
        )


def _textured_plane() -> np.ndarray[Any, np.dtype[np.float32]]:
    """(96, 128, 6) float32: enough of a cloud to run every step on."""
    v, u = np.mgrid[:96, :128].astype(np.float32)
    channels = np.empty((96, 128, 6), np.float32)
    channels[..., 0], channels[..., 1], channels[..., 2] = (u - 64) / 6, (v - 48) / 6, 20.0
    channels[..., 3] = 100.0 + 20.0 * np.sin(0.9 * u) * np.cos(0.7 * v)
    channels[..., 4], channels[..., 5] = 1.0, 0.01
    return channels
