"""ROS 2 messages and bags, byte for byte against rosbags' serialisation and type hashes."""

from __future__ import annotations

from dataclasses import fields as members
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scans import DIST, START_NS, K, messages, points_of, pose_of

from endo3d.schemas import messages as m
from endo3d.services.exchange import ros2_types
from endo3d.services.exchange.ros2_bag import write_ros2_bag
from endo3d.services.exchange.ros2_messages import TOPICS, Ros2Message, Translator
from endo3d.services.runtime.errors import UserError

store = get_typestore(Stores.ROS2_JAZZY)


def as_rosbags(name: str, values: dict[str, Any]) -> Any:
    """Our nested mappings as rosbags' message objects."""
    made = {}
    for field in ros2_types.fields(name):
        value = values[field.name]
        if field.type in ros2_types.DEFINITIONS:
            one = field.count is None
            made[field.name] = as_rosbags(field.type, value) if one else [as_rosbags(field.type, v) for v in value]
        elif field.count is not None:
            made[field.name] = np.asarray(value, ros2_types.PRIMITIVES[field.type][0])
        else:
            made[field.name] = value
    return store.types[name](**made)


def converted() -> dict[str, Ros2Message]:
    """One message of each topic."""
    translator = Translator()
    found = [translated for message in messages(3) for translated in translator.of(message)]
    return {translated.topic: translated for translated in [*found, *translator.map_now()]}


@pytest.mark.parametrize("name", ros2_types.DEFINITIONS)
def test_type_hashes_and_members_are_those_of_ros(name: str) -> None:
    assert ros2_types.type_hash(name) == store.hash_rihs01(name)
    ours = [field.name for field in ros2_types.fields(name)]
    assert ours == [
        field.name for field in members(store.types[name]) if field.name.islower() and field.name != "__msgtype__"
    ]


@pytest.mark.parametrize("topic", TOPICS)
def test_messages_are_serialised_as_rosbags_does(topic: str) -> None:
    message = converted()[topic]
    expected = bytes(store.serialize_cdr(as_rosbags(message.type, message.content), message.type))
    assert message.cdr() == expected


def test_points_are_in_metres_and_organised() -> None:
    message = converted()["points"]
    read = store.deserialize_cdr(message.cdr(), message.type)
    kind = np.dtype([(field.name, "<f4") for field in read.fields])
    points = read.data.view(kind).reshape(read.height, read.width)
    expected = points_of(2)
    assert not read.is_dense
    for name in ("x", "y", "z", "sigma"):
        np.testing.assert_allclose(points[name], expected[name] * 1e-3, rtol=1e-6)
    for name in ("intensity", "quality"):
        np.testing.assert_array_equal(points[name], expected[name])


def test_odometry_turns_the_covariance_into_the_world() -> None:
    message = converted()["odometry"]
    read = store.deserialize_cdr(message.cdr(), message.type)
    T = pose_of(2)
    np.testing.assert_allclose([read.pose.pose.position.x, read.pose.pose.position.z], 1e-3 * T[[0, 2], 3])
    C = read.pose.covariance.reshape(6, 6)
    in_camera = np.diag([4e-12, 9e-12, 25e-12])
    np.testing.assert_allclose(C[:3, :3], T[:3, :3] @ in_camera @ T[:3, :3].T, rtol=1e-6, atol=1e-18)
    np.testing.assert_allclose(C[3:, 3:], T[:3, :3] @ np.diag([1e-8, 4e-8, 16e-8]) @ T[:3, :3].T, rtol=1e-6, atol=1e-14)


def test_a_lost_pose_is_not_odometry() -> None:
    pose = next(message for message in messages(1) if isinstance(message, m.Pose))
    lost = m.Pose(pose.stamp_ns, 0, pose.T_world_camera, pose.information, m.Tracking.LOST, 0, np.eye(6)[0], 0, 0, 0)
    assert list(Translator().of(lost)) == []


def test_rosbags_reads_the_bag(tmp_path: Path) -> None:
    counts = write_ros2_bag(messages(5), tmp_path / "bag")
    with AnyReader([tmp_path / "bag"]) as bag:
        seen = {name: info.msgcount for name, info in bag.topics.items()}
        assert seen == dict(counts)
        assert seen["/endo3d/image_raw"] == seen["/endo3d/camera_info"] == seen["/endo3d/odometry"] == seen["/tf"] == 5
        assert bag.start_time == START_NS
        last = {}
        for connection, stamp_ns, raw in bag.messages():
            message = bag.deserialize(raw, connection.msgtype)
            last[connection.topic] = message
            header = message.transforms[0].header if connection.topic == "/tf" else message.header
            assert header.stamp.sec * 10**9 + header.stamp.nanosec == stamp_ns
    frames = [message for message in messages(5) if isinstance(message, m.Frame)]
    image = last["/endo3d/image_raw"]
    assert (image.encoding, image.step) == ("mono8", 480)
    np.testing.assert_array_equal(image.data.reshape(300, 480), frames[-1].image)
    info = last["/endo3d/camera_info"]
    np.testing.assert_array_equal(info.k.reshape(3, 3), K)
    np.testing.assert_array_equal(info.d, DIST)
    depth = last["/endo3d/depth"].data.view("<f4").reshape(30, 48)
    np.testing.assert_allclose(depth, 1e-3 * points_of(4)["z"], atol=1.1e-7)
    merged = last["/endo3d/map"]
    assert merged.height == 1
    assert merged.is_dense
    assert merged.width > points_of(0).size - 12  # five clouds, one point per voxel


def test_a_bag_never_overwrites(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="exists"):
        write_ros2_bag(messages(1), tmp_path)
