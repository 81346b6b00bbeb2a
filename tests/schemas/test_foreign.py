"""Ours read by Foxglove's stock classes, and theirs by us."""

from __future__ import annotations

import numpy as np
import pytest
from any_message import MESSAGES, example
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from hypothesis import given
from scipy.spatial.transform import Rotation

from endo3d.schemas import codec, endo3d_pb2, messages, topics

STOCK = {
    topics.FRAME: RawImage,
    topics.CLOUD: PointCloud,
    topics.DEPTH: RawImage,
    topics.POSE: PoseInFrame,
    topics.PART_POSE: PoseInFrame,
    topics.TRANSFORM: FrameTransform,
    topics.MAP: PointCloud,
    topics.MODE: endo3d_pb2.Mode,
    topics.CAMERA: CameraCalibration,
    topics.PROJECTOR: CameraCalibration,
    topics.TRUTH: endo3d_pb2.Truth,
    topics.STATUS: endo3d_pb2.Status,
    topics.LOG: Log,
}
TYPES = {
    PackedElementField.INT16: "<i2",
    PackedElementField.UINT16: "<u2",
    PackedElementField.FLOAT32: "<f4",
    PackedElementField.FLOAT64: "<f8",
}


def stamp(proto) -> int:
    return proto.timestamp.seconds * 10**9 + proto.timestamp.nanos


@pytest.mark.parametrize("topic", topics.TOPICS, ids=lambda topic: topic.name)
def test_the_schema_names_what_the_stock_class_parses(topic):
    message = example(topic)
    proto = STOCK[topic].FromString(codec.encode(message))
    assert proto.DESCRIPTOR.full_name == codec.schema(topic).name
    assert stamp(proto) == message.stamp_ns


@given(MESSAGES[topics.FRAME])
def test_a_stock_image_shows_our_pixels(frame):
    proto = RawImage.FromString(codec.encode(frame))
    assert (proto.width, proto.height) == frame.image.shape[::-1]
    assert proto.step == frame.image.shape[1] * frame.image.itemsize
    assert proto.encoding == {1: "mono8", 2: "mono16"}[frame.image.itemsize]
    assert proto.frame_id == frame.frame_id
    assert proto.data == frame.image.tobytes()


def test_a_depth_map_is_a_16uc1_image():
    proto = RawImage.FromString(codec.encode(example(topics.DEPTH)))
    assert proto.encoding == "16UC1"
    assert proto.data == example(topics.DEPTH).depth.tobytes()


@pytest.mark.parametrize("topic", [topics.CLOUD, topics.MAP], ids=lambda topic: topic.name)
def test_a_stock_cloud_names_our_fields(topic):
    points = example(topic).points
    proto = PointCloud.FromString(codec.encode(example(topic)))
    assert proto.point_stride == points.itemsize
    assert [field.name for field in proto.fields] == list(points.dtype.names)
    raw = np.frombuffer(proto.data, np.uint8).reshape(-1, proto.point_stride)
    for field in proto.fields:
        kind = np.dtype(TYPES[field.type])
        column = raw[:, field.offset : field.offset + kind.itemsize].copy().view(kind)[:, 0]
        np.testing.assert_array_equal(column, points[field.name].ravel())
    orientation = proto.pose.orientation
    assert (orientation.x, orientation.y, orientation.z, orientation.w) == (0, 0, 0, 1)


@given(MESSAGES[topics.POSE])
def test_a_stock_pose_is_the_same_rotation(pose):
    proto = PoseInFrame.FromString(codec.encode(pose)).pose
    q = proto.orientation
    R = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    np.testing.assert_allclose(R, pose.T_world_camera[:3, :3], rtol=0, atol=1e-12)
    assert [proto.position.x, proto.position.y, proto.position.z] == pose.T_world_camera[:3, 3].tolist()
    assert max(q.x, q.y, q.z, q.w, key=abs) > 0


def test_a_stock_calibration_has_every_matrix():
    camera = example(topics.CAMERA)
    proto = CameraCalibration.FromString(codec.encode(camera))
    assert proto.distortion_model == "plumb_bob"
    assert list(proto.D) == camera.dist.tolist()
    np.testing.assert_array_equal(np.reshape(proto.K, (3, 3)), camera.K)
    np.testing.assert_array_equal(np.reshape(proto.R, (3, 3)), np.eye(3))
    np.testing.assert_array_equal(np.reshape(proto.P, (3, 4)), np.c_[camera.K, np.zeros(3)])


@pytest.mark.parametrize("level", messages.Level)
def test_a_stock_log_line_has_our_level(level):
    line = messages.LogLine(1, level, "text", "decoder")
    proto = Log.FromString(codec.encode(line))
    assert Log.Level.Name(proto.level) == level.name
    assert (proto.message, proto.name) == ("text", "decoder")


def foreign_image(step=3, encoding="mono8", rows=2):
    """As the library writes it: ``data`` in the middle, ``frame_id`` behind it."""
    image = RawImage(frame_id="lab", width=3, height=rows, encoding=encoding, step=step)
    image.data = bytes(range(rows * step))
    image.timestamp.seconds = 5
    return image.SerializeToString()


def test_a_stock_image_is_a_frame_of_unknown_pattern():
    raw = foreign_image()
    frame = codec.decode(topics.FRAME, raw)
    assert (frame.stamp_ns, frame.frame_id, frame.pattern_set) == (5 * 10**9, "lab", "")
    assert (frame.slot, frame.sequence, frame.epoch, frame.camera_frame_id) == (-1, 0, 0, 0)
    assert frame.image.tolist() == [[0, 1, 2], [3, 4, 5]]
    assert np.shares_memory(frame.image, np.frombuffer(raw, np.uint8))
    assert codec.data_span(raw) == (raw.index(bytes(range(6))), raw.index(bytes(range(6))) + 6)


def test_padded_rows_are_gathered():
    image = codec.decode(topics.FRAME, foreign_image(step=5)).image
    assert image.tolist() == [[0, 1, 2], [5, 6, 7]]
    assert image.flags.c_contiguous
    assert not image.flags.writeable
    wide = codec.decode(topics.FRAME, foreign_image(step=7, encoding="mono16")).image
    assert wide.tolist() == [[0x0100, 0x0302, 0x0504], [0x0807, 0x0A09, 0x0C0B]]


def test_a_stock_depth_image_is_in_mm():
    depth = codec.decode(topics.DEPTH, foreign_image(step=6, encoding="16UC1"))
    assert (depth.scale_mm, depth.offset_mm, depth.grid_px) == (1.0, 0.0, 1.0)
    assert depth.depth[0].tolist() == [0x0100, 0x0302, 0x0504]


def foreign_cloud(dtype, count=4):
    points = np.zeros(count, dtype)
    for at, name in enumerate(points.dtype.names):
        points[name] = np.arange(count) + 10 * at
    proto = PointCloud(frame_id="lab", point_stride=points.itemsize, data=points.tobytes())
    numbers = {kind: number for number, kind in TYPES.items()}
    for name, (kind, offset) in points.dtype.fields.items():
        proto.fields.add(name=name, offset=offset, type=numbers[kind.str])
    return points, proto.SerializeToString()


def test_a_stock_cloud_is_one_row_and_nan_where_nothing_is_known():
    points, raw = foreign_cloud([("z", "<f8"), ("x", "<f4"), ("y", "<i2"), ("red", "<u2")])
    cloud = codec.decode(topics.CLOUD, raw)
    assert cloud.points.dtype == messages.POINT
    assert cloud.points.shape == (1, 4)
    for name in "xyz":
        np.testing.assert_array_equal(cloud.points[name][0], points[name])
    assert np.isnan(cloud.channels[..., 3:]).all()
    assert (cloud.valid_count, cloud.grid_px, cloud.epoch, cloud.sequence) == (4, 1.0, 0, 0)


def test_a_number_too_large_for_a_point_is_infinite():
    proto = PointCloud(point_stride=24, data=np.array([1e300, 0, -1e300]).tobytes())
    for at, name in enumerate("xyz"):
        proto.fields.add(name=name, offset=8 * at, type=PackedElementField.FLOAT64)
    points = codec.decode(topics.CLOUD, proto.SerializeToString()).points
    assert points[0, 0].tolist()[:3] == (np.inf, 0, -np.inf)


def test_a_stock_cloud_is_a_whole_map():
    points, raw = foreign_cloud([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
    delta = codec.decode(topics.MAP, raw)
    np.testing.assert_array_equal(delta.points, points)
    assert (delta.reset, delta.map_points, delta.removed.shape) == (True, 4, (0, 3))


def test_a_stock_pose_tracks_and_knows_nothing_else():
    pose = codec.decode(topics.POSE, PoseInFrame(frame_id="lab").SerializeToString())
    on_part = codec.decode(topics.PART_POSE, PoseInFrame(frame_id="lab").SerializeToString())
    assert on_part.state is messages.Fit.ALIGNED
    assert not on_part.information.any()
    np.testing.assert_array_equal(pose.T_world_camera, np.eye(4))
    assert pose.state is messages.Tracking.TRACKING
    assert np.isnan([pose.sigma_weak_um, pose.inlier_share, pose.residual_um, pose.photometric_share]).all()
    assert not pose.information.any()


def test_a_long_quaternion_is_a_rotation():
    proto = FrameTransform(parent_frame_id="a", child_frame_id="b")
    proto.rotation.z = proto.rotation.w = 3.0
    T = codec.decode(topics.TRANSFORM, proto.SerializeToString()).T_parent_child
    np.testing.assert_allclose(T, [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], atol=1e-15)


def test_fewer_distortion_coefficients_are_zeros():
    proto = CameraCalibration(width=4, height=3, K=np.eye(3).ravel(), D=[0.1, 0.2])
    assert codec.decode(topics.CAMERA, proto.SerializeToString()).dist.tolist() == [0.1, 0.2, 0, 0, 0]
