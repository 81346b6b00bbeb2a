"""The messages that carry a large array, to and from protobuf headers: Frame, Cloud, DepthMap, MapDelta.

``fill_*`` writes everything but the array into an empty protobuf message; ``read_*`` makes the message of a
protobuf message and a view of the array's bytes. What a foreign writer leaves out gets the value that says
so: slot -1, no pattern set, zero counts, a scale of 1.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d.schemas import points
from endo3d.schemas.geometry import fill_stamp, read_stamp
from endo3d.schemas.messages import Cloud, DepthMap, Frame, MapDelta
from endo3d.schemas.wire import Malformed

_PIXELS = {"mono8": "|u1", "8UC1": "|u1", "mono16": "<u2", "16UC1": "<u2"}
_KEY = np.dtype("<i2")
"""One coordinate of a voxel key."""


def _size(value: float, what: str) -> float:
    if not 0 < value < math.inf:
        raise Malformed(f"{what} is {value}: not a size")
    return value


def _fill_image(proto: Any, image: NDArray[Any], encodings: dict[str, str]) -> None:
    encoding = encodings.get(image.dtype.str)
    if encoding is None or image.ndim != 2 or image.size == 0:
        known = " or ".join(encodings.values())
        raise ValueError(f"an image is (height, width) of {known}, not {image.shape} {image.dtype}")
    proto.height, proto.width = image.shape
    proto.encoding = encoding
    proto.step = image.shape[1] * image.itemsize


def _read_image(proto: Any, data: memoryview) -> NDArray[Any]:
    """(height, width), a view unless a foreign writer padded the rows."""
    if proto.encoding not in _PIXELS:
        raise Malformed(f"the encoding is {proto.encoding!r}, not one of {', '.join(_PIXELS)}")
    dtype = np.dtype(_PIXELS[proto.encoding])
    height, width, step = proto.height, proto.width, proto.step
    row = width * dtype.itemsize
    if height == 0 or width == 0 or step < row or height * step != len(data):
        raise Malformed(
            f"{height} rows of {step} bytes for {width} {proto.encoding} pixels, in {len(data)} bytes"
        )
    if step == row:
        return np.ndarray((height, width), dtype, data)
    image = np.ndarray((height, row), np.uint8, data, strides=(step, 1)).copy().view(dtype)
    image.flags.writeable = False
    return image


def fill_frame(proto: Any, frame: Frame) -> None:
    fill_stamp(proto.timestamp, frame.stamp_ns)
    proto.frame_id = frame.frame_id
    _fill_image(proto, frame.image, {"|u1": "mono8", "<u2": "mono16"})
    label = proto.label
    label.sequence = frame.sequence
    label.pattern_set = frame.pattern_set
    label.slot = frame.slot
    label.epoch = frame.epoch
    label.exposure_us = frame.exposure_us
    label.trigger_ns = frame.trigger_ns
    label.camera_frame_id = frame.camera_frame_id


def read_frame(proto: Any, data: memoryview) -> Frame:
    label = proto.label
    return Frame(
        stamp_ns=read_stamp(proto.timestamp),
        sequence=label.sequence,
        image=_read_image(proto, data),
        pattern_set=label.pattern_set,
        slot=label.slot if proto.HasField("label") else -1,
        epoch=label.epoch,
        exposure_us=label.exposure_us,
        trigger_ns=label.trigger_ns,
        camera_frame_id=label.camera_frame_id,
        frame_id=proto.frame_id,
    )


def fill_depth(proto: Any, depth: DepthMap) -> None:
    fill_stamp(proto.timestamp, depth.stamp_ns)
    proto.frame_id = depth.frame_id
    _fill_image(proto, depth.depth, {"<u2": "16UC1"})
    label = proto.label
    label.sequence = depth.sequence
    label.scale_mm = _size(depth.scale_mm, "scale_mm")
    label.offset_mm = depth.offset_mm
    label.grid_px = _size(depth.grid_px, "grid_px")


def read_depth(proto: Any, data: memoryview) -> DepthMap:
    """A foreign depth image is in mm: the ROS convention of 16UC1 (REP 118)."""
    image = _read_image(proto, data)
    if image.dtype != np.uint16:
        raise Malformed(f"a depth image is 16UC1, not {proto.encoding}")
    label, ours = proto.label, proto.HasField("label")
    if not math.isfinite(label.offset_mm):
        raise Malformed(f"offset_mm is {label.offset_mm}")
    return DepthMap(
        stamp_ns=read_stamp(proto.timestamp),
        sequence=label.sequence,
        depth=image,
        scale_mm=_size(label.scale_mm, "scale_mm") if ours else 1.0,
        offset_mm=label.offset_mm,
        grid_px=_size(label.grid_px, "grid_px") if ours else 1.0,
        frame_id=proto.frame_id,
    )


def _fill_points(proto: Any, stored: NDArray[Any]) -> None:
    proto.MergeFromString(points.layout_of(stored.dtype))


def fill_cloud(proto: Any, cloud: Cloud) -> None:
    if cloud.points.ndim != 2 or cloud.points.size == 0:
        raise ValueError(f"a cloud's points are (height, width), not {cloud.points.shape}")
    fill_stamp(proto.timestamp, cloud.stamp_ns)
    proto.frame_id = cloud.frame_id
    _fill_points(proto, cloud.points)
    label = proto.label
    label.sequence = cloud.sequence
    label.height, label.width = cloud.points.shape
    label.window_frames = cloud.window_frames
    label.newest_stamp_ns = cloud.newest_stamp_ns
    label.epoch = cloud.epoch
    label.pattern_set = cloud.pattern_set
    label.grid_px = _size(cloud.grid_px, "grid_px")
    label.valid_count = cloud.valid_count
    label.slot_slips = cloud.slot_slips


def read_cloud(proto: Any, data: memoryview) -> Cloud:
    """A foreign cloud is one row of points."""
    label, ours = proto.label, proto.HasField("label")
    dtype = points.read_fields(proto)
    shape = (label.height, label.width) if ours else (1, len(data) // dtype.itemsize)
    if not all(shape):
        raise Malformed(f"a cloud of {shape} points")
    stored = points.as_point(points.view_points(data, dtype, shape))
    stamp_ns = read_stamp(proto.timestamp)
    return Cloud(
        stamp_ns=stamp_ns,
        sequence=label.sequence,
        points=stored,
        window_frames=label.window_frames,
        newest_stamp_ns=label.newest_stamp_ns if ours else stamp_ns,
        epoch=label.epoch,
        pattern_set=label.pattern_set,
        grid_px=_size(label.grid_px, "grid_px") if ours else 1.0,
        valid_count=label.valid_count if ours else int(np.isfinite(stored["z"]).sum()),
        slot_slips=label.slot_slips,
        frame_id=proto.frame_id,
    )


def fill_map(proto: Any, delta: MapDelta) -> None:
    if delta.points.ndim != 1:
        raise ValueError(f"a map's points are (n,), not {delta.points.shape}")
    if delta.removed.ndim != 2 or delta.removed.shape[1] != 3 or delta.removed.dtype != _KEY:
        raise ValueError(f"removed keys are (m, 3) int16, not {delta.removed.shape} {delta.removed.dtype}")
    fill_stamp(proto.timestamp, delta.stamp_ns)
    proto.frame_id = delta.frame_id
    _fill_points(proto, delta.points)
    label = proto.label
    label.sequence = delta.sequence
    label.removed = delta.removed.tobytes()
    label.revision = delta.revision
    label.reset = delta.reset
    label.map_points = delta.map_points
    label.merging_distance_mm = _size(delta.merging_distance_mm, "merging_distance_mm")


def read_map(proto: Any, data: memoryview) -> MapDelta:
    """A foreign cloud is a whole map: it replaces what was there."""
    label, ours = proto.label, proto.HasField("label")
    dtype = points.read_fields(proto)
    stored = points.view_points(data, dtype, (len(data) // dtype.itemsize,))
    if len(label.removed) % (3 * _KEY.itemsize):
        raise Malformed(f"{len(label.removed)} bytes of removed keys: not a multiple of three int16")
    return MapDelta(
        stamp_ns=read_stamp(proto.timestamp),
        sequence=label.sequence,
        points=stored,
        removed=np.frombuffer(label.removed, _KEY).reshape(-1, 3),
        revision=label.revision,
        reset=label.reset if ours else True,
        map_points=label.map_points if ours else len(stored),
        merging_distance_mm=_size(label.merging_distance_mm, "merging_distance_mm") if ours else 1.0,
        frame_id=proto.frame_id,
    )
