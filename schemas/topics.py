"""THE table of what travels: key, message, rate, queue depth, logged or not. Nothing restates it."""

from __future__ import annotations

from dataclasses import dataclass

from endo3d.schemas import messages as m


@dataclass(frozen=True, slots=True)
class Topic:
    """One stream of one kind of message."""

    name: str
    message: type
    rate_hz: float
    """The most that is ever published."""
    depth: int = 512
    """Samples a reader's queue holds before the oldest is dropped and counted."""
    bulk: bool = False
    """Large arrays: shared memory, ring queue and worker thread, a chunk of its own in the archive."""
    log_hz: float = float("inf")
    """The most that is archived; 0 is never, infinity is every message."""
    latched: bool = False
    """A late reader gets the last message."""
    per_service: bool = False
    """Every service writes its own key below this one."""

    def key(self, rig: str, service: str | None = None) -> str:
        """The Zenoh key: ``endo3d/<rig>/<name>[/<service>]``; without a service ``/*`` matches all."""
        key = f"endo3d/{rig}/{self.name}"
        return f"{key}/{service or '*'}" if self.per_service else key

    def channel(self, service: str = "") -> str:
        """The archive's channel: ``/<name>[/<service>]``."""
        return f"/{self.name}/{service}" if self.per_service else f"/{self.name}"


# Deep enough for a processor that is taken away for a tenth of a second: decoding catches up.
FRAME = Topic("frame", m.Frame, rate_hz=180, depth=24, bulk=True)
CLOUD = Topic("cloud", m.Cloud, rate_hz=180, depth=4, bulk=True, log_hz=2)
DEPTH = Topic("depth", m.DepthMap, rate_hz=180, depth=4, bulk=True, log_hz=30)
POSE = Topic("pose", m.Pose, rate_hz=180)
PART_POSE = Topic("part_pose", m.PartPose, rate_hz=180)
TRANSFORM = Topic("transform", m.Transform, rate_hz=180)
MAP = Topic("map", m.MapDelta, rate_hz=30)
MODE = Topic("mode", m.Mode, rate_hz=10, latched=True)
CAMERA = Topic("calibration/camera", m.CameraCalibration, rate_hz=1, latched=True)
PROJECTOR = Topic("calibration/projector", m.ProjectorCalibration, rate_hz=1, latched=True)
TRUTH = Topic("truth", m.Truth, rate_hz=180)
STATUS = Topic("status", m.Status, rate_hz=2, per_service=True)
LOG = Topic("log", m.LogLine, rate_hz=100, per_service=True)

TOPICS = (FRAME, CLOUD, DEPTH, POSE, PART_POSE, TRANSFORM, MAP, MODE, CAMERA, PROJECTOR, TRUTH, STATUS, LOG)
BY_NAME = {topic.name: topic for topic in TOPICS}
BY_MESSAGE = {topic.message: topic for topic in TOPICS}


def of(message: m.Message) -> Topic:
    """The topic a message travels on."""
    return BY_MESSAGE[type(message)]


def control_key(rig: str, service: str, verb: str) -> str:
    """Where a service answers a command: a queryable, JSON in, JSON (or a message's bytes) out."""
    return f"endo3d/{rig}/control/{service}/{verb}"


def alive_key(rig: str, service: str) -> str:
    """The liveliness token of a service."""
    return f"endo3d/{rig}/alive/{service}"
