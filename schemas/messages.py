"""The messages: frozen dataclasses over numpy arrays, units in the names.

Lengths are millimetres, angles radians, stamps nanoseconds of the rig's clock. A pose ``T_a_b`` maps
coordinates of frame b into frame a. Arrays may be views into shared memory: read them, never write them,
and copy what has to outlive the step that received them. Messages only grow: fields are added at the end,
with a default, so that an old log still decodes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

POINT = np.dtype([(name, "<f4") for name in ("x", "y", "z", "intensity", "quality", "sigma")])
"""One point of a cloud: position and 1-sigma of z in mm, intensity in grey values, quality 0..1."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One camera image and which pattern it shows (foxglove.RawImage + endo3d.FrameLabel)."""

    stamp_ns: int
    """Mid-exposure."""
    sequence: int
    """Counts frames of this rig; a gap is a lost frame."""
    image: NDArray[np.uint8] | NDArray[np.uint16]
    """(height, width) grey values."""
    pattern_set: str
    """The pattern sequence as text, e.g. ``interleaved f1=25``: parsed by ``endo3d_core.patterns``."""
    slot: int
    """Index into the pattern set; -1 when unknown."""
    epoch: int
    """Counts the projector's starts: frames of different epochs never decode together."""
    exposure_us: float
    trigger_ns: int
    """The camera's own time of the exposure's start, rig clock."""
    camera_frame_id: int
    """The camera's own count."""
    frame_id: str = "camera"


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """An organised point cloud, decoded at camera rate (foxglove.PointCloud + endo3d.CloudLabel)."""

    stamp_ns: int
    """Mid-exposure of the window's centre frame."""
    sequence: int
    """The centre frame's."""
    points: NDArray[Any]
    """(height, width) of ``POINT``; x, y, z are NaN where nothing valid was measured."""
    window_frames: int
    """Frames this cloud was computed from."""
    newest_stamp_ns: int
    """Mid-exposure of the window's newest frame: what latency is counted from."""
    epoch: int
    """The frames'."""
    pattern_set: str
    """The frames'."""
    grid_px: float
    """Camera pixels per grid step."""
    valid_count: int
    """Points with a measured position."""
    slot_slips: int = 0
    """Slot slips detected and repaired since the epoch began."""
    frame_id: str = "camera"

    @property
    def channels(self) -> NDArray[np.float32]:
        """(height, width, 6) float32 view: x, y, z, intensity, quality, sigma."""
        return self.points.view(np.float32).reshape(*self.points.shape, len(POINT.names or ()))


@dataclass(frozen=True, slots=True, eq=False)
class DepthMap:
    """The same measurement as a 16-bit image: z_mm = offset_mm + scale_mm * value, 0 = invalid."""

    stamp_ns: int
    sequence: int
    depth: NDArray[np.uint16]
    """(height, width)."""
    scale_mm: float
    offset_mm: float
    grid_px: float
    frame_id: str = "camera"


class Tracking(StrEnum):
    TRACKING = "tracking"
    DEGENERATE = "degenerate"
    LOST = "lost"
    RELOCALISED = "relocalised"


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """Where the tip is, and how well that is known (foxglove.PoseInFrame + endo3d.PoseHealth)."""

    stamp_ns: int
    sequence: int
    T_world_camera: NDArray[np.float64]
    """(4, 4), mm."""
    information: NDArray[np.float64]
    """(6, 6) of (translation mm, rotation rad) in the camera frame."""
    state: Tracking
    sigma_weak_um: float
    """1-sigma along the weakest direction, rotation scaled to um at the working distance."""
    weak_direction: NDArray[np.float64]
    """(6,) unit vector of that direction."""
    inlier_share: float
    residual_um: float
    photometric_share: float
    submap: int = 0
    newest_stamp_ns: int = 0
    frame_id: str = "world"


class Fit(StrEnum):
    SEARCHING = "searching"
    ALIGNED = "aligned"
    DEGENERATE = "degenerate"
    LOST = "lost"


@dataclass(frozen=True, slots=True, eq=False)
class PartPose:
    """Where the tip is in the coordinates of a part's CAD model (foxglove.PoseInFrame + endo3d.PartHealth)."""

    stamp_ns: int
    sequence: int
    T_part_camera: NDArray[np.float64]
    """(4, 4), mm; the coordinates are the model file's."""
    information: NDArray[np.float64]
    """(6, 6) of (translation mm, rotation rad) in the camera frame; zero while searching or lost."""
    state: Fit
    """How the scan lies on the model; ``degenerate``: it may still slide along ``weak_direction``."""
    tracking: Tracking
    """Of the odometry pose it rests on."""
    sigma_weak_um: float
    """1-sigma along the weakest direction, rotation scaled to um at the working distance."""
    weak_direction: NDArray[np.float64]
    """(6,) unit vector of that direction."""
    inlier_share: float
    """Of the visible map points, those that lie on the model."""
    residual_um: float
    """Their robust rms distance from it."""
    model: str = ""
    """The model's file name."""
    frame_id: str = "part"


@dataclass(frozen=True, slots=True, eq=False)
class Transform:
    """A rigid transform for viewers (foxglove.FrameTransform)."""

    stamp_ns: int
    parent_frame_id: str
    child_frame_id: str
    T_parent_child: NDArray[np.float64]
    """(4, 4), mm."""


@dataclass(frozen=True, slots=True, eq=False)
class MapDelta:
    """What changed in the merged map (foxglove.PointCloud + endo3d.MapLabel); replaces by voxel key."""

    stamp_ns: int
    sequence: int
    points: NDArray[Any]
    """(n,) structured: the fields of ``endo3d_core.merging.MAP_POINT``; ``kx, ky, kz`` is the voxel key."""
    removed: NDArray[np.int16]
    """(m, 3) voxel keys that are gone."""
    revision: int
    """Counts deltas; a gap means: ask for a snapshot."""
    reset: bool
    """The map was emptied before this delta (a snapshot is a delta with reset)."""
    map_points: int
    merging_distance_mm: float
    frame_id: str = "world"


@dataclass(frozen=True, slots=True, eq=False)
class Mode:
    """What the projector shows from ``start_ns`` on (endo3d.Mode)."""

    stamp_ns: int
    mode: str
    """``conventional``, ``interleaved``, or a stack's own name for a pattern set."""
    pattern_set: str
    epoch: int
    start_ns: int
    """Start of slot 0."""
    frame_period_ns: int
    exposure_us: float
    running: bool


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """Pinhole and Brown-Conrady of the camera (foxglove.CameraCalibration)."""

    stamp_ns: int
    width: int
    height: int
    K: NDArray[np.float64]
    """(3, 3)."""
    dist: NDArray[np.float64]
    """(5,) k1 k2 p1 p2 k3."""
    frame_id: str = "camera"


@dataclass(frozen=True, slots=True, eq=False)
class ProjectorCalibration:
    """The same of the projector, and where it stands (foxglove.CameraCalibration + endo3d.RigLabel)."""

    stamp_ns: int
    width: int
    height: int
    K: NDArray[np.float64]
    dist: NDArray[np.float64]
    T_projector_camera: NDArray[np.float64]
    """(4, 4), mm."""
    yaml: str = ""
    """The calibration file, byte for byte."""
    frame_id: str = "projector"


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What the virtual rig knows about a frame (endo3d.Truth); simulated runs only."""

    stamp_ns: int
    sequence: int
    T_scene_camera: NDArray[np.float64]
    """(4, 4), mm."""
    scene: str
    slow_motion: float = 1.0
    """Seconds of wall time per second of simulated motion."""


class ServiceState(StrEnum):
    STARTING = "starting"
    READY = "ready"
    RUNNING = "running"
    DEGRADED = "degraded"
    FAILED = "failed"
    STOPPED = "stopped"


@dataclass(frozen=True, slots=True, eq=False)
class Status:
    """How a service does, about once a second (endo3d.Status). Written by the runner, not by the service."""

    stamp_ns: int
    service: str
    host: str
    pid: int
    state: ServiceState
    note: str
    """One line for people: why degraded, what to do."""
    rate_hz: float
    """Steps per second on the service's main input, or messages per second of a source."""
    latency_p50_ms: float
    """From the exposure of the newest frame involved to the end of the step."""
    latency_p99_ms: float
    cpu_share: float
    """Of one core."""
    memory_mb: float
    received: Mapping[str, int] = field(default_factory=dict)
    """Messages per topic read, since start."""
    published: Mapping[str, int] = field(default_factory=dict)
    dropped: Mapping[str, int] = field(default_factory=dict)
    """Lost per cause, since start: ``frame:missed``, ``frame:malformed``, ``cloud:exhausted``."""
    values: Mapping[str, float] = field(default_factory=dict)
    """The service's own figures, e.g. the recorder's bytes and queue."""


class Level(StrEnum):
    DEBUG = "debug"
    INFO = "info"
    WARNING = "warning"
    ERROR = "error"
    FATAL = "fatal"


@dataclass(frozen=True, slots=True, eq=False)
class LogLine:
    """One line per event (foxglove.Log)."""

    stamp_ns: int
    level: Level
    message: str
    service: str
    file: str = ""
    line: int = 0


Message = (
    Frame
    | Cloud
    | DepthMap
    | Pose
    | PartPose
    | Transform
    | MapDelta
    | Mode
    | CameraCalibration
    | ProjectorCalibration
    | Truth
    | Status
    | LogLine
)
