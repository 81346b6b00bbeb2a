"""What a log, or a run so far, amounts to: the map, the way of the tip, and how well it went."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d.schemas import topics
from endo3d.schemas.messages import (
    POINT,
    CameraCalibration,
    Cloud,
    DepthMap,
    Frame,
    MapDelta,
    Message,
    Mode,
    Pose,
    Status,
    Tracking,
    Truth,
)
from endo3d.services.archive.reader import Log
from endo3d.services.views.merged import MergedMap, starts_afresh

SECOND_NS = 1_000_000_000
KEEP_GROWTH = 1.25
"""A shown frame is replaced when the log has grown by this: it ends up from the last fifth of the scan."""


@dataclass
class Scan:
    """Collects messages one by one; copies what it keeps."""

    merged: MergedMap = field(default_factory=MergedMap)
    poses: list[Pose] = field(default_factory=list)
    truths: list[Truth] = field(default_factory=list)
    statuses: dict[str, list[Status]] = field(default_factory=dict)
    frame: Frame | None = None
    depth: DepthMap | None = None
    camera: CameraCalibration | None = None
    mode: Mode | None = None
    frames: int = 0
    first_ns: int = 0
    last_ns: int = 0
    working_distance_mm: float = float("nan")
    kept_at: int = 0
    single: NDArray[Any] | None = None
    """(n,) ``POINT``, camera frame: the last cloud, what is shown when nothing was merged."""

    def add(self, message: Message) -> None:
        """Takes one message of any topic."""
        match message:
            case Frame():
                self._add_frame(message)
            case DepthMap() if self.frame is not None and (
                self.depth is None or self.depth.sequence < self.frame.sequence <= message.sequence
            ):
                self.depth = replace(message, depth=message.depth.copy())
            case Cloud() if message.valid_count:
                self.single = message.points[np.isfinite(message.points["z"])]
                self.working_distance_mm = float(np.median(self.single["z"]))
            case MapDelta():
                self.merged.add(message)
                if starts_afresh(message):
                    self.poses.clear()
            case Pose():
                self.poses.append(message)
            case Truth():
                self.truths.append(message)
            case CameraCalibration():
                self.camera = message
            case Mode():
                self.mode = message
            case Status():
                self.statuses.setdefault(message.service, []).append(message)
            case _:
                pass

    def _add_frame(self, frame: Frame) -> None:
        self.first_ns = self.first_ns or frame.stamp_ns
        self.last_ns = frame.stamp_ns
        self.frames += 1
        if self.frame is None or self.frames >= KEEP_GROWTH * self.kept_at:
            self.kept_at = self.frames
            self.frame = replace(frame, image=frame.image.copy())

    @classmethod
    def of(cls, messages: Iterable[Message]) -> Scan:
        """All of a log."""
        scan = cls()
        for message in messages:
            scan.add(message)
        return scan

    @classmethod
    def of_log(cls, log: Log) -> Scan:
        """Of a finished log, reading what is shown only: small messages whole, images of one second."""
        scan = cls.of(log.messages(*(topic for topic in topics.TOPICS if not topic.bulk)))
        at_ns = log.end_ns - round(0.2 * (log.end_ns - log.start_ns))
        images = log.messages(topics.FRAME, topics.DEPTH, start_ns=at_ns, end_ns=at_ns + SECOND_NS)
        for message in images:
            scan.add(message)
        # of many clouds one is enough to know the working distance; without a map the last one is what is shown
        clouds_from_ns = at_ns if scan.merged.points() is not None else 0
        for message in log.messages(topics.CLOUD, start_ns=clouds_from_ns):
            scan.add(message)
        stamps_ns = [record.publish_ns for record in log.records((topics.FRAME,), check=False)]
        if stamps_ns:
            scan.frames, scan.first_ns, scan.last_ns = len(stamps_ns), min(stamps_ns), max(stamps_ns)
        return scan

    @property
    def simulated(self) -> bool:
        """Truth is known of simulated frames only."""
        return bool(self.truths)

    @property
    def seconds(self) -> float:
        return (self.last_ns - self.first_ns) * 1e-9

    def track(self) -> NDArray[np.float64]:
        """(n, 4, 4) T_world_camera of every pose that isn't lost."""
        kept = [pose.T_world_camera for pose in self.poses if pose.state is not Tracking.LOST]
        return np.array(kept, float).reshape(-1, 4, 4)

    def viewer(self) -> NDArray[np.float64]:
        """(3,) mm: where the tip was on average; the origin without poses."""
        track = self.track()
        return np.asarray(track[:, :3, 3].mean(axis=0)) if len(track) else np.zeros(3)

    def length_mm(self) -> float:
        """The way of the tip, its jitter smoothed over ten poses."""
        positions = self.track()[:, :3, 3]
        if len(positions) < 2:
            return 0.0
        width = min(10, len(positions))
        smooth = np.stack([np.convolve(axis, np.full(width, 1 / width), "valid") for axis in positions.T], axis=1)
        return float(np.linalg.norm(np.diff(smooth, axis=0), axis=1).sum())

    def points(self) -> NDArray[Any]:
        """(n,) structured, world frame: the merged map, else the last cloud."""
        merged = self.merged.points()
        if merged is not None and len(merged):
            return merged
        return self.single if self.single is not None else np.empty(0, POINT)


def xyz(points: NDArray[Any]) -> NDArray[np.float32]:
    """(n, 3) float32 mm of structured points."""
    return np.stack([points[axis] for axis in ("x", "y", "z")], axis=-1).astype(np.float32, copy=False)
