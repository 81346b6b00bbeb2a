"""The ROS 2 bridge: the live scan as topics of a ROS 2 graph that speaks Zenoh (rmw_zenoh). Optional."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

from pydantic import Field

from endo3d.schemas import topics
from endo3d.schemas.messages import Message
from endo3d.services.exchange.ros2_messages import Translator
from endo3d.services.exchange.ros2_session import Ros2Session
from endo3d.services.runtime.service import Config, Service

Ros2Topic = Literal["image_raw", "camera_info", "depth", "points", "map", "odometry", "/tf"]
BULK = ("image_raw", "camera_info", "depth", "points")


class Ros2BridgeConfig(Config):
    router: str = "tcp/127.0.0.1:7447"
    """The endpoint of the ROS 2 router (rmw_zenohd)."""
    domain: int = Field(0, ge=0, le=232)
    """ROS_DOMAIN_ID."""
    namespace: str = "endo3d"
    """Topics are /<namespace>/points and so on; /tf is everybody's."""
    topics: tuple[Ros2Topic, ...] = ("image_raw", "camera_info", "depth", "points", "map", "odometry", "/tf")
    rate_hz: float = Field(30.0, gt=0)
    """The most of images, depth maps and clouds."""
    map_hz: float = Field(1.0, gt=0)


class Ros2Bridge(Service[Ros2BridgeConfig]):
    """Translates and publishes; a process of its own, so that a slow network slows nothing else."""

    Config = Ros2BridgeConfig
    reads = (
        topics.FRAME,
        topics.CLOUD,
        topics.DEPTH,
        topics.POSE,
        topics.TRANSFORM,
        topics.MAP,
        topics.CAMERA,
    )
    optional = reads
    newest = (topics.FRAME, topics.CLOUD, topics.DEPTH)
    nice = 5

    def __init__(self, config: Ros2BridgeConfig) -> None:
        super().__init__(config)
        self.translator = Translator(1e9 / config.map_hz)
        self.session: Ros2Session | None = None
        self._sent_ns: dict[str, int] = {}

    def open(self) -> None:
        """Joins the ROS graph. Raises ``UserError`` without a router."""
        self.session = Ros2Session(
            self.config.router, domain=self.config.domain, namespace=self.config.namespace
        )

    def step(self, message: Message) -> Iterator[Message]:
        """Publishes a message to ROS; yields nothing."""
        for translated in self.translator.of(message):
            wanted = translated.topic in self.config.topics
            if wanted and self.session is not None and self._due(translated.topic, translated.stamp_ns):
                self.session.publish(translated)
        return iter(())

    def close(self) -> None:
        if self.session is not None:
            self.session.close()

    def _due(self, topic: str, stamp_ns: int) -> bool:
        """Whether a period has passed since the last of a bulk topic, or time went back."""
        last = self._sent_ns.get(topic)
        if topic in BULK and last is not None and 0 <= stamp_ns - last < 0.98e9 / self.config.rate_hz:
            return False
        self._sent_ns[topic] = stamp_ns
        return True
