"""The ROS 2 bridge on the wire: keys, bytes, attachments and tokens as a node of rmw_zenoh would see them."""

from __future__ import annotations

import queue
import socket
import struct
from collections import defaultdict
from collections.abc import Iterator
from contextlib import suppress

import pytest
import zenoh
from rosbags.typesys import Stores, get_typestore
from scans import START_NS, messages

from endo3d.services.exchange.ros2_session import liveliness_key, topic_key
from endo3d.services.ros2_bridge import Ros2Bridge, Ros2BridgeConfig
from endo3d.services.runtime.errors import UserError

store = get_typestore(Stores.ROS2_JAZZY)


class Ros:
    """A router with a listener that takes everything of a domain, and its graph."""

    def __init__(self, domain: int, endpoint: str = "") -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.endpoint = endpoint or f"tcp/127.0.0.1:{probe.getsockname()[1]}"
        config = zenoh.Config()
        config.insert_json5("mode", '"router"')
        config.insert_json5("listen/endpoints", f'["{self.endpoint}"]')
        config.insert_json5("scouting/multicast/enabled", "false")
        self.session = zenoh.open(config)
        self.samples: queue.Queue[zenoh.Sample] = queue.Queue()
        self.tokens: queue.Queue[zenoh.Sample] = queue.Queue()
        self.session.declare_subscriber(f"{domain}/**", self.samples.put)
        self.session.liveliness().declare_subscriber("@ros2_lv/**", self.tokens.put, history=True)

    def take(self, count: int) -> dict[str, list[zenoh.Sample]]:
        """So many samples, by key."""
        taken = defaultdict(list)
        for _ in range(count):
            sample = self.samples.get(timeout=90)
            taken[str(sample.key_expr)].append(sample)
        return taken


@pytest.fixture
def ros() -> Iterator[Ros]:
    listener = Ros(domain=7)
    yield listener
    listener.session.close()


@pytest.fixture
def bridge(ros: Ros) -> Iterator[Ros2Bridge]:
    service = Ros2Bridge(Ros2BridgeConfig(router=ros.endpoint, domain=7, map_hz=1.0))
    service.open()
    yield service
    service.close()


def test_keys_are_those_of_rmw_zenoh() -> None:
    # the hashes as `ros2 topic info -v` prints them
    assert topic_key(0, "/endo3d/points", "sensor_msgs/msg/PointCloud2") == (
        "0/endo3d/points/sensor_msgs::msg::dds_::PointCloud2_/"
        + store.hash_rihs01("sensor_msgs/msg/PointCloud2")
    )
    token = liveliness_key(2, "aac3178e", 10, "MP", "listener", "/chatter", "sensor_msgs/msg/Image")
    assert token == (
        "@ros2_lv/2/aac3178e/0/10/MP/%/%/listener/%chatter/sensor_msgs::msg::dds_::Image_/"
        + store.hash_rihs01("sensor_msgs/msg/Image")
        + "/::,10:,:,:,,"
    )
    assert liveliness_key(2, "aac3178e", 0, "NN", "listener") == "@ros2_lv/2/aac3178e/0/0/NN/%/%/listener"


def test_a_listener_gets_what_rosbags_would_have_sent(ros: Ros, bridge: Ros2Bridge) -> None:
    frames = 5
    for message in messages(frames):
        assert list(bridge.step(message)) == []
    taken = ros.take(6 * frames + 1)
    assert sum(map(len, taken.values())) == 6 * frames + 1
    for key, samples in taken.items():
        _, *name, kind, type_hash = key.split("/")
        package, folder, _, message_name = kind.split("::")
        msgtype = f"{package}/{folder}/{message_name.removesuffix('_')}"
        assert type_hash == store.hash_rihs01(msgtype)
        gids = set()
        for k, sample in enumerate(samples):
            payload = sample.payload.to_bytes()
            assert payload[:4] == b"\x00\x01\x00\x00"
            read = store.deserialize_cdr(payload, msgtype)
            assert bytes(store.serialize_cdr(read, msgtype)) == payload
            assert sample.attachment is not None
            attached = sample.attachment.to_bytes()
            sequence, stamp_ns, length = struct.unpack("<qqB", attached[:17])
            assert (len(attached), length, sequence) == (33, 16, k + 1)
            assert stamp_ns == START_NS + 40_000_000 * k
            gids.add(attached[17:])
        assert len(gids) == 1, name


def test_the_graph_sees_node_and_publishers_come_and_go(ros: Ros, bridge: Ros2Bridge) -> None:
    for message in messages(1):
        list(bridge.step(message))
    came = [ros.tokens.get(timeout=90) for _ in range(8)]
    assert all(sample.kind == zenoh.SampleKind.PUT for sample in came)
    keys = sorted(str(sample.key_expr).split("/")[5:9] for sample in came)
    assert keys == sorted([["NN", "%", "%", "endo3d"], *[["MP", "%", "%", "endo3d"]] * 7])
    entities = {str(sample.key_expr).split("/")[4] for sample in came}
    assert len(entities) == 8
    bridge.close()
    gone = [ros.tokens.get(timeout=90) for _ in range(8)]
    assert all(sample.kind == zenoh.SampleKind.DELETE for sample in gone)


def test_images_are_thinned_and_poses_are_not(ros: Ros) -> None:
    bridge = Ros2Bridge(
        Ros2BridgeConfig(router=ros.endpoint, domain=7, rate_hz=10, topics=("image_raw", "/tf"))
    )
    bridge.open()
    for message in messages(50, hz=50.0):
        list(bridge.step(message))
    taken = ros.take(10 + 50)
    bridge.close()
    assert sorted(map(len, taken.values())) == [10, 50]


def test_a_restarted_router_is_found_again(ros: Ros, bridge: Ros2Bridge) -> None:
    first = list(messages(1))
    for message in first:
        list(bridge.step(message))
    ros.take(7)
    ros.session.close()
    again = Ros(7, ros.endpoint)
    for message in messages(2000, hz=50.0, start_s=1.0):
        list(bridge.step(message))
        with suppress(queue.Empty):
            again.samples.get(timeout=0.02)
            break
    else:
        pytest.fail("nothing came any more")
    assert again.tokens.get(timeout=90).kind == zenoh.SampleKind.PUT
    again.session.close()


def test_without_a_router_it_says_what_to_start() -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        bridge = Ros2Bridge(Ros2BridgeConfig(router=f"tcp/127.0.0.1:{probe.getsockname()[1]}"))
        with pytest.raises(UserError, match="rmw_zenohd"):
            bridge.open()
