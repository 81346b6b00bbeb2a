"""A ROS 2 bag: a folder with an MCAP file of CDR messages and the metadata.yaml that ros2 bag wants."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import yaml
from mcap.writer import CompressionType, Writer

from endo3d.schemas.messages import Message
from endo3d.services.exchange import ros2_types
from endo3d.services.exchange.ros2_messages import TOPICS, Ros2Message, Translator
from endo3d.services.runtime.errors import UserError

QOS = """\
- history: keep_last
  depth: 10
  reliability: reliable
  durability: volatile
  deadline: {sec: 2147483647, nsec: 4294967295}
  lifespan: {sec: 2147483647, nsec: 4294967295}
  liveliness: automatic
  liveliness_lease_duration: {sec: 2147483647, nsec: 4294967295}
  avoid_ros_namespace_conventions: false
"""


def write_ros2_bag(messages: Iterable[Message], folder: str | Path, *, namespace: str = "endo3d") -> Counter[str]:
    """Writes images, depth, clouds, odometry, transforms, camera info and, at the end, the merged map.

    Returns the messages per topic. Raises ``UserError`` if the folder exists.
    """
    target = Path(folder)
    if target.exists():
        raise UserError(f"{target} exists; a bag is a new folder")
    target.mkdir(parents=True)
    with (target / f"{target.name}_0.mcap").open("wb") as file:
        bag = _Bag(Writer(file, compression=CompressionType.NONE), namespace)
        translator = Translator()
        for message in messages:
            for translated in translator.of(message):
                bag.put(translated)
        for translated in translator.map_now():
            bag.put(translated)
        bag.finish()
    (target / "metadata.yaml").write_text(yaml.safe_dump(bag.metadata(target.name), sort_keys=False))
    return bag.counts


class _Bag:
    def __init__(self, writer: Writer, namespace: str) -> None:
        self.writer = writer
        self.counts: Counter[str] = Counter()
        self.start_ns, self.end_ns = 0, 0
        self._namespace = namespace
        self._channels: dict[str, int] = {}
        writer.start(profile="ros2", library="endo3d")

    def put(self, message: Ros2Message) -> None:
        name = full_topic(message.topic, self._namespace)
        channel = self._channels.get(name)
        if channel is None:
            definition = ros2_types.text(message.type).encode()
            schema = self.writer.register_schema(message.type, "ros2msg", definition)
            channel = self.writer.register_channel(name, "cdr", schema, {"offered_qos_profiles": QOS})
            self._channels[name] = channel
        self.writer.add_message(channel, message.stamp_ns, message.cdr(), message.stamp_ns, self.counts[name])
        self.counts[name] += 1
        self.start_ns = min(self.start_ns or message.stamp_ns, message.stamp_ns)
        self.end_ns = max(self.end_ns, message.stamp_ns)

    def finish(self) -> None:
        self.writer.finish()  # type: ignore[no-untyped-call]

    def metadata(self, name: str) -> dict[str, object]:
        types = {full_topic(topic, self._namespace): kind for topic, kind in TOPICS.items()}
        times = {
            "duration": {"nanoseconds": self.end_ns - self.start_ns},
            "starting_time": {"nanoseconds_since_epoch": self.start_ns},
            "message_count": sum(self.counts.values()),
        }
        topics = [
            {
                "topic_metadata": {
                    "name": topic,
                    "type": types[topic],
                    "serialization_format": "cdr",
                    "offered_qos_profiles": QOS,
                },
                "message_count": count,
            }
            for topic, count in self.counts.items()
        ]
        path = f"{name}_0.mcap"
        information = {
            "version": 5,
            "storage_identifier": "mcap",
            **times,
            "topics_with_message_count": topics,
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [path],
            "files": [{"path": path, **times}],
        }
        return {"rosbag2_bagfile_information": information}


def full_topic(topic: str, namespace: str) -> str:
    """``/endo3d/points``; a topic with a slash, /tf, is the same for everybody."""
    return topic if topic.startswith("/") else f"/{namespace}/{topic}"
