"""A ROS 2 node as rmw_zenoh sees one, without ROS: keys, attachments and liveliness tokens of its protocol.

Layout of keys and tokens: rmw_zenoh's docs/design.md. This session is the bridge's own, to the ROS router;
the rig's shared memory never goes through it.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import zenoh
from zenoh.ext import Int64, z_serialize

from endo3d.services.exchange.ros2_bag import full_topic
from endo3d.services.exchange.ros2_messages import TOPICS, Ros2Message
from endo3d.services.exchange.ros2_types import type_hash
from endo3d.services.runtime.errors import UserError

QOS = "::,10:,:,:,,"
"""Keep the last ten; everything else the default."""
NODE_ENTITY = 0


@dataclass
class _Writer:
    publisher: zenoh.Publisher
    token: zenoh.LivelinessToken
    gid: bytes
    sequence: int = 0


class Ros2Session:
    """Publishes on ROS topics; each exists from the first message on."""

    def __init__(self, router: str, *, domain: int = 0, node: str = "endo3d", namespace: str = "endo3d") -> None:
        """router: endpoint such as ``tcp/127.0.0.1:7447``. Raises ``UserError`` when it doesn't answer."""
        self._domain, self._node, self._namespace = domain, node, namespace
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", f'["{router}"]')
        config.insert_json5("scouting/multicast/enabled", "false")
        try:
            self._session = zenoh.open(config)
        except zenoh.ZError as error:
            raise UserError(f"no ROS 2 router at {router}; start one: ros2 run rmw_zenoh_cpp rmw_zenohd") from error
        self._zid = str(self._session.info.zid())
        node_token = liveliness_key(domain, self._zid, NODE_ENTITY, "NN", node)
        self._node_token = self._session.liveliness().declare_token(node_token)
        self._writers: dict[str, _Writer] = {}

    def publish(self, message: Ros2Message) -> None:
        """Sends one message; a slow router loses it rather than holding us up."""
        writer = self._writers.get(message.topic) or self._declare(message.topic)
        writer.sequence += 1
        attached = attachment(writer.sequence, message.stamp_ns, writer.gid)
        writer.publisher.put(message.cdr(), attachment=attached)

    def close(self) -> None:
        """Takes the node off the graph."""
        self._session.close()

    def _declare(self, topic: str) -> _Writer:
        name, kind = full_topic(topic, self._namespace), TOPICS[topic]
        entity = NODE_ENTITY + 1 + len(self._writers)
        token = liveliness_key(self._domain, self._zid, entity, "MP", self._node, name, kind)
        writer = _Writer(
            self._session.declare_publisher(
                topic_key(self._domain, name, kind), congestion_control=zenoh.CongestionControl.DROP
            ),
            self._session.liveliness().declare_token(token),
            hashlib.blake2b(token.encode(), digest_size=16).digest(),
        )
        self._writers[topic] = writer
        return writer


def topic_key(domain: int, name: str, kind: str) -> str:
    """``0/endo3d/points/sensor_msgs::msg::dds_::PointCloud2_/RIHS01_...``."""
    return f"{domain}/{name.strip('/')}/{dds_name(kind)}/{type_hash(kind)}"


def dds_name(kind: str) -> str:
    """``sensor_msgs/msg/Image`` -> ``sensor_msgs::msg::dds_::Image_``."""
    package, folder, name = kind.split("/")
    return f"{package}::{folder}::dds_::{name}_"


def liveliness_key(domain: int, zid: str, entity: int, what: str, node: str, name: str = "", kind: str = "") -> str:
    """What tells the ROS graph of a node (``NN``), or of a publisher (``MP``) of topic ``name``."""
    key = f"@ros2_lv/{domain}/{zid}/{NODE_ENTITY}/{entity}/{what}/%/%/{node}"
    if what == "NN":
        return key
    return f"{key}/{name.replace('/', '%')}/{dds_name(kind)}/{type_hash(kind)}/{QOS}"


def attachment(sequence: int, stamp_ns: int, gid: bytes) -> zenoh.ZBytes:
    """33 bytes: the sequence number, the source time in ns, and the publisher's 16-byte identity."""
    return z_serialize((Int64(sequence), Int64(stamp_ns), gid))
