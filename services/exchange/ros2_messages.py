"""endo3d's messages as ROS 2 has them: metres instead of millimetres, everything else as it is."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from endo3d.schemas import messages as m
from endo3d.services.exchange import cdr
from endo3d.services.exchange.depth import depth_mm
from endo3d.services.exchange.finite import finite
from endo3d.services.views.merged import MergedMap
from endo3d_core import rigid
from endo3d_core.trajectory import covariance

IMAGE, CLOUD, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/CameraInfo"
ODOMETRY, TF = "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"

TOPICS = {
    "image_raw": IMAGE,
    "camera_info": INFO,
    "depth": IMAGE,
    "points": CLOUD,
    "map": CLOUD,
    "odometry": ODOMETRY,
    "/tf": TF,
}
"""Topic: type. Those without a slash live below the rig's namespace."""
METRES = ("x", "y", "z", "sigma")
FLOAT32 = 7


class Ros2Message(NamedTuple):
    """A message and where it goes."""

    topic: str
    """A key of ``TOPICS``."""
    stamp_ns: int
    content: dict[str, Any]

    @property
    def type(self) -> str:
        return TOPICS[self.topic]

    def cdr(self) -> bytes:
        """On the wire."""
        return cdr.encode(self.type, self.content)


class Translator:
    """Tells ROS 2 what endo3d's messages say; what it has no word for stays unsaid.

    The calibration goes with every image, at its stamp, as ROS wants it; the merged map goes out whole, every
    ``map_period_ns`` of message time, or only when asked.
    """

    def __init__(self, map_period_ns: float | None = None) -> None:
        self._camera: m.CameraCalibration | None = None
        self._merged = MergedMap()
        self._delta: m.MapDelta | None = None
        self._map_period_ns = map_period_ns
        self._map_ns: int | None = None

    def of(self, message: m.Message) -> Iterator[Ros2Message]:
        """One message in, those of ROS out."""
        match message:
            case m.CameraCalibration():
                self._camera = message
            case m.Frame():
                yield Ros2Message("image_raw", message.stamp_ns, image(message, message.image))
                if self._camera is not None:
                    info = camera_info(replace(self._camera, stamp_ns=message.stamp_ns))
                    yield Ros2Message("camera_info", message.stamp_ns, info)
            case m.DepthMap():
                z_m = depth_mm(message) * np.float32(1e-3)
                yield Ros2Message("depth", message.stamp_ns, image(message, z_m))
            case m.Cloud():
                yield Ros2Message("points", message.stamp_ns, cloud(message, message.points))
            case m.Pose() if message.state is not m.Tracking.LOST:
                yield Ros2Message("odometry", message.stamp_ns, odometry(message))
            case m.Transform():
                yield Ros2Message("/tf", message.stamp_ns, {"transforms": [transform(message)]})
            case m.MapDelta():
                self._merged.add(message)
                self._delta = replace(message, points=message.points[:0], removed=message.removed[:0])
                if self._map_due(message.stamp_ns):
                    yield from self.map_now()
            case _:
                pass

    def map_now(self) -> Iterator[Ros2Message]:
        """The merged map as it stands; nothing before the first points."""
        points = self._merged.points()
        if self._delta is not None and points is not None and len(points):
            self._map_ns = self._delta.stamp_ns
            yield Ros2Message("map", self._delta.stamp_ns, cloud(self._delta, points))

    def _map_due(self, stamp_ns: int) -> bool:
        if self._map_period_ns is None:
            return False
        return self._map_ns is None or not 0 <= stamp_ns - self._map_ns < self._map_period_ns


def header(stamp_ns: int, frame_id: str) -> dict[str, Any]:
    return {"stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}, "frame_id": frame_id}


ENCODINGS = {"u1": "mono8", "u2": "mono16", "f4": "32FC1"}


def image(message: m.Frame | m.DepthMap, pixels: NDArray[np.generic]) -> dict[str, Any]:
    """Grey values as mono8 or mono16; depth as 32FC1 in m, NaN where invalid (REP 118)."""
    height, width = int(pixels.shape[0]), int(pixels.shape[1])
    return {
        "header": header(message.stamp_ns, message.frame_id),
        "height": height,
        "width": width,
        "encoding": ENCODINGS[pixels.dtype.str[1:]],
        "is_bigendian": 0,
        "step": width * pixels.itemsize,
        "data": np.ascontiguousarray(pixels).reshape(-1).view(np.uint8),
    }


def cloud(message: m.Cloud | m.MapDelta, points: NDArray[Any]) -> dict[str, Any]:
    """The points' 32-bit fields; organised when the points are (height, width), positions and sigma in m."""
    names = [name for name in points.dtype.names or () if points.dtype[name] == np.float32]
    metric = np.empty(points.shape, [(name, "<f4") for name in names])
    for name in names:
        metric[name] = points[name] * np.float32(1e-3) if name in METRES else points[name]
    shape: tuple[int, ...] = points.shape
    height, width = shape if len(shape) == 2 else (1, shape[0])
    return {
        "header": header(message.stamp_ns, message.frame_id),
        "height": height,
        "width": width,
        "fields": [{"name": name, "offset": 4 * k, "datatype": FLOAT32, "count": 1} for k, name in enumerate(names)],
        "is_bigendian": False,
        "point_step": metric.itemsize,
        "row_step": width * metric.itemsize,
        "data": metric.reshape(-1).view(np.uint8),
        "is_dense": len(finite(points)) == points.size,
    }


def odometry(message: m.Pose) -> dict[str, Any]:
    """The pose; its covariance in the world's axes (translation, rotation; m, rad); an unknown twist."""
    T = message.T_world_camera
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = T[:3, :3]
    metres = np.diag([1e-3] * 3 + [1.0] * 3)
    C = metres @ turn @ covariance(message.information) @ turn.T @ metres
    still = {"linear": _vector((0, 0, 0)), "angular": _vector((0, 0, 0))}
    return {
        "header": header(message.stamp_ns, message.frame_id),
        "child_frame_id": "camera",
        "pose": {
            "pose": {"position": _vector(1e-3 * T[:3, 3]), "orientation": _quaternion(T)},
            "covariance": C.reshape(-1),
        },
        # a covariance of -1 says, as sensor_msgs/Imu does, that there is no estimate
        "twist": {"twist": still, "covariance": np.r_[-1.0, np.zeros(35)]},
    }


def transform(message: m.Transform) -> dict[str, Any]:
    """A transform of the tree."""
    T = message.T_parent_child
    return {
        "header": header(message.stamp_ns, message.parent_frame_id),
        "child_frame_id": message.child_frame_id,
        "transform": {"translation": _vector(1e-3 * T[:3, 3]), "rotation": _quaternion(T)},
    }


def camera_info(message: m.CameraCalibration) -> dict[str, Any]:
    """The pinhole, with Brown and Conrady's distortion, which ROS calls plumb_bob in the same order."""
    roi = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
    return {
        "header": header(message.stamp_ns, message.frame_id),
        "height": message.height,
        "width": message.width,
        "distortion_model": "plumb_bob",
        "d": message.dist,
        "k": message.K.reshape(-1),
        "r": np.eye(3).reshape(-1),
        "p": np.hstack([message.K, np.zeros((3, 1))]).reshape(-1),
        "binning_x": 0,
        "binning_y": 0,
        "roi": roi,
    }


def _vector(values: Any) -> dict[str, float]:
    return {axis: float(value) for axis, value in zip("xyz", values, strict=True)}


def _quaternion(T: NDArray[np.float64]) -> dict[str, float]:
    return {axis: float(value) for axis, value in zip("xyzw", rigid.quaternion(T[:3, :3]), strict=True)}
