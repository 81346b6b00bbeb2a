"""The messages without a large array, to and from protobuf: poses, calibrations, modes, status, log lines.

``fill_*`` writes a message into an empty protobuf message, ``read_*`` makes the message of one. A figure that
a foreign writer leaves out is NaN.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.Log_pb2 import Log as LogProto
from numpy.typing import NDArray

from endo3d.schemas import endo3d_pb2
from endo3d.schemas.geometry import fill_stamp, fill_transform, read_matrix, read_stamp, read_transform
from endo3d.schemas.messages import (
    CameraCalibration,
    Fit,
    Level,
    LogLine,
    Mode,
    PartPose,
    Pose,
    ProjectorCalibration,
    ServiceState,
    Status,
    Tracking,
    Transform,
    Truth,
)
from endo3d.schemas.wire import Malformed

_TRACKING = {state: endo3d_pb2.PoseHealth.Tracking.Value(state.name) for state in Tracking}
_TRACKING_OF = {number: state for state, number in _TRACKING.items()}
_FIT = {fit: endo3d_pb2.PartHealth.Fit.Value(fit.name) for fit in Fit}
_FIT_OF = {number: fit for fit, number in _FIT.items()}
_STATE = {state: endo3d_pb2.Status.State.Value(state.name) for state in ServiceState}
_STATE_OF = {number: state for state, number in _STATE.items()}
_LEVEL = {level: LogProto.Level.Value(level.name) for level in Level}
_LEVEL_OF = {number: level for level, number in _LEVEL.items()} | {LogProto.UNKNOWN: Level.INFO}


def _known(table: Mapping[Any, Any], number: int, what: str) -> Any:
    if number not in table:
        raise Malformed(f"{what} {number} is unknown")
    return table[number]


def _flat(values: NDArray[np.float64], shape: tuple[int, ...], what: str) -> list[float]:
    if values.shape != shape:
        raise ValueError(f"{what} has the shape {shape}, not {values.shape}")
    flat: list[float] = values.ravel().tolist()
    return flat


def fill_pose(proto: Any, pose: Pose) -> None:
    fill_stamp(proto.timestamp, pose.stamp_ns)
    proto.frame_id = pose.frame_id
    fill_transform(proto.pose.position, proto.pose.orientation, pose.T_world_camera)
    label = proto.label
    label.sequence = pose.sequence
    label.state = _TRACKING[pose.state]
    label.information.extend(_flat(pose.information, (6, 6), "information"))
    label.sigma_weak_um = pose.sigma_weak_um
    label.weak_direction.extend(_flat(pose.weak_direction, (6,), "weak_direction"))
    label.inlier_share = pose.inlier_share
    label.residual_um = pose.residual_um
    label.photometric_share = pose.photometric_share
    label.submap = pose.submap
    label.newest_stamp_ns = pose.newest_stamp_ns


def read_pose(proto: Any) -> Pose:
    """A foreign pose tracks, and nothing is known about how well."""
    stamp_ns = read_stamp(proto.timestamp)
    T = read_transform(proto.pose.position, proto.pose.orientation, proto.pose.HasField("orientation"))
    if not proto.HasField("label"):
        return Pose(
            stamp_ns=stamp_ns,
            sequence=0,
            T_world_camera=T,
            information=np.zeros((6, 6)),
            state=Tracking.TRACKING,
            sigma_weak_um=math.nan,
            weak_direction=np.full(6, np.nan),
            inlier_share=math.nan,
            residual_um=math.nan,
            photometric_share=math.nan,
            newest_stamp_ns=stamp_ns,
            frame_id=proto.frame_id,
        )
    label = proto.label
    return Pose(
        stamp_ns=stamp_ns,
        sequence=label.sequence,
        T_world_camera=T,
        information=read_matrix(label.information, 6, 6, "information"),
        state=_known(_TRACKING_OF, label.state, "tracking state"),
        sigma_weak_um=label.sigma_weak_um,
        weak_direction=read_matrix(label.weak_direction, 1, 6, "weak_direction")[0],
        inlier_share=label.inlier_share,
        residual_um=label.residual_um,
        photometric_share=label.photometric_share,
        submap=label.submap,
        newest_stamp_ns=label.newest_stamp_ns,
        frame_id=proto.frame_id,
    )


def fill_part_pose(proto: Any, pose: PartPose) -> None:
    fill_stamp(proto.timestamp, pose.stamp_ns)
    proto.frame_id = pose.frame_id
    fill_transform(proto.pose.position, proto.pose.orientation, pose.T_part_camera)
    label = proto.label
    label.sequence = pose.sequence
    label.state = _FIT[pose.state]
    label.tracking = _TRACKING[pose.tracking]
    label.information.extend(_flat(pose.information, (6, 6), "information"))
    label.sigma_weak_um = pose.sigma_weak_um
    label.weak_direction.extend(_flat(pose.weak_direction, (6,), "weak_direction"))
    label.inlier_share = pose.inlier_share
    label.residual_um = pose.residual_um
    label.model = pose.model


def read_part_pose(proto: Any) -> PartPose:
    """A foreign pose is aligned, and nothing is known about how well."""
    stamp_ns = read_stamp(proto.timestamp)
    T = read_transform(proto.pose.position, proto.pose.orientation, proto.pose.HasField("orientation"))
    if not proto.HasField("label"):
        return PartPose(
            stamp_ns=stamp_ns,
            sequence=0,
            T_part_camera=T,
            information=np.zeros((6, 6)),
            state=Fit.ALIGNED,
            tracking=Tracking.TRACKING,
            sigma_weak_um=math.nan,
            weak_direction=np.full(6, np.nan),
            inlier_share=math.nan,
            residual_um=math.nan,
            frame_id=proto.frame_id,
        )
    label = proto.label
    return PartPose(
        stamp_ns=stamp_ns,
        sequence=label.sequence,
        T_part_camera=T,
        information=read_matrix(label.information, 6, 6, "information"),
        state=_known(_FIT_OF, label.state, "fit"),
        tracking=_known(_TRACKING_OF, label.tracking, "tracking state"),
        sigma_weak_um=label.sigma_weak_um,
        weak_direction=read_matrix(label.weak_direction, 1, 6, "weak_direction")[0],
        inlier_share=label.inlier_share,
        residual_um=label.residual_um,
        model=label.model,
        frame_id=proto.frame_id,
    )


def fill_frame_transform(proto: Any, transform: Transform) -> None:
    fill_stamp(proto.timestamp, transform.stamp_ns)
    proto.parent_frame_id = transform.parent_frame_id
    proto.child_frame_id = transform.child_frame_id
    fill_transform(proto.translation, proto.rotation, transform.T_parent_child)


def read_frame_transform(proto: Any) -> Transform:
    return Transform(
        stamp_ns=read_stamp(proto.timestamp),
        parent_frame_id=proto.parent_frame_id,
        child_frame_id=proto.child_frame_id,
        T_parent_child=read_transform(proto.translation, proto.rotation, proto.HasField("rotation")),
    )


def _fill_lens(proto: Any, lens: CameraCalibration | ProjectorCalibration) -> None:
    """``plumb_bob`` is Foxglove's (and ROS's) name of Brown-Conrady with k1 k2 p1 p2 k3."""
    fill_stamp(proto.timestamp, lens.stamp_ns)
    proto.frame_id = lens.frame_id
    proto.width, proto.height = lens.width, lens.height
    proto.distortion_model = "plumb_bob"
    proto.D.extend(_flat(lens.dist, (5,), "dist"))
    proto.K.extend(_flat(lens.K, (3, 3), "K"))
    proto.R.extend(np.eye(3).ravel().tolist())
    proto.P.extend(np.hstack((lens.K, np.zeros((3, 1)))).ravel().tolist())


def _read_lens(proto: Any) -> dict[str, Any]:
    """Fewer than five distortion coefficients: the others are zero."""
    if proto.distortion_model not in ("", "plumb_bob") or len(proto.D) > 5:
        raise Malformed(
            f"distortion {proto.distortion_model!r} with {len(proto.D)} coefficients: not plumb_bob"
        )
    K = read_matrix(proto.K, 3, 3, "K")
    dist = np.zeros(5)
    dist[: len(proto.D)] = proto.D
    if not (np.isfinite(K).all() and np.isfinite(dist).all()):
        raise Malformed("K or D is not finite")
    return {
        "stamp_ns": read_stamp(proto.timestamp),
        "width": proto.width,
        "height": proto.height,
        "K": K,
        "dist": dist,
        "frame_id": proto.frame_id,
    }


def fill_camera(proto: Any, camera: CameraCalibration) -> None:
    _fill_lens(proto, camera)


def read_camera(proto: Any) -> CameraCalibration:
    return CameraCalibration(**_read_lens(proto))


def fill_projector(proto: Any, projector: ProjectorCalibration) -> None:
    _fill_lens(proto, projector)
    proto.label.T_projector_camera.extend(_flat(projector.T_projector_camera, (4, 4), "T_projector_camera"))
    proto.label.yaml = projector.yaml


def read_projector(proto: Any) -> ProjectorCalibration:
    """Without a label nothing says where the projector stands: malformed."""
    T = read_matrix(proto.label.T_projector_camera, 4, 4, "T_projector_camera")
    return ProjectorCalibration(**_read_lens(proto), T_projector_camera=T, yaml=proto.label.yaml)


def fill_mode(proto: Any, mode: Mode) -> None:
    fill_stamp(proto.timestamp, mode.stamp_ns)
    proto.mode = mode.mode
    proto.pattern_set = mode.pattern_set
    proto.epoch = mode.epoch
    proto.start_ns = mode.start_ns
    proto.frame_period_ns = mode.frame_period_ns
    proto.exposure_us = mode.exposure_us
    proto.running = mode.running


def read_mode(proto: Any) -> Mode:
    return Mode(
        stamp_ns=read_stamp(proto.timestamp),
        mode=proto.mode,
        pattern_set=proto.pattern_set,
        epoch=proto.epoch,
        start_ns=proto.start_ns,
        frame_period_ns=proto.frame_period_ns,
        exposure_us=proto.exposure_us,
        running=proto.running,
    )


def fill_truth(proto: Any, truth: Truth) -> None:
    fill_stamp(proto.timestamp, truth.stamp_ns)
    proto.sequence = truth.sequence
    proto.T_scene_camera.extend(_flat(truth.T_scene_camera, (4, 4), "T_scene_camera"))
    proto.scene = truth.scene
    proto.slow_motion = truth.slow_motion


def read_truth(proto: Any) -> Truth:
    return Truth(
        stamp_ns=read_stamp(proto.timestamp),
        sequence=proto.sequence,
        T_scene_camera=read_matrix(proto.T_scene_camera, 4, 4, "T_scene_camera"),
        scene=proto.scene,
        slow_motion=proto.slow_motion,
    )


def fill_status(proto: Any, status: Status) -> None:
    fill_stamp(proto.timestamp, status.stamp_ns)
    proto.service = status.service
    proto.host = status.host
    proto.pid = status.pid
    proto.state = _STATE[status.state]
    proto.note = status.note
    proto.rate_hz = status.rate_hz
    proto.latency_p50_ms = status.latency_p50_ms
    proto.latency_p99_ms = status.latency_p99_ms
    proto.cpu_share = status.cpu_share
    proto.memory_mb = status.memory_mb
    proto.received.update(status.received)
    proto.published.update(status.published)
    proto.dropped.update(status.dropped)
    proto.values.update(status.values)


def read_status(proto: Any) -> Status:
    return Status(
        stamp_ns=read_stamp(proto.timestamp),
        service=proto.service,
        host=proto.host,
        pid=proto.pid,
        state=_known(_STATE_OF, proto.state, "service state"),
        note=proto.note,
        rate_hz=proto.rate_hz,
        latency_p50_ms=proto.latency_p50_ms,
        latency_p99_ms=proto.latency_p99_ms,
        cpu_share=proto.cpu_share,
        memory_mb=proto.memory_mb,
        received=dict(proto.received),
        published=dict(proto.published),
        dropped=dict(proto.dropped),
        values=dict(proto.values),
    )


def fill_log(proto: Any, line: LogLine) -> None:
    fill_stamp(proto.timestamp, line.stamp_ns)
    proto.level = _LEVEL[line.level]
    proto.message = line.message
    proto.name = line.service
    proto.file = line.file
    proto.line = line.line


def read_log(proto: Any) -> LogLine:
    return LogLine(
        stamp_ns=read_stamp(proto.timestamp),
        level=_known(_LEVEL_OF, proto.level, "log level"),
        message=proto.message,
        service=proto.name,
        file=proto.file,
        line=proto.line,
    )
