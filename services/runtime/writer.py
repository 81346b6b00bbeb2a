"""A publication: one zenoh publisher, its samples numbered so that readers can count what they missed."""

from __future__ import annotations

import threading
from typing import Any, Final

import zenoh
from zenoh.ext import CacheConfig, MissDetectionConfig, declare_advanced_publisher

from endo3d.schemas import codec
from endo3d.schemas.topics import Topic

_SEQUENCE_MASK: Final = 0xFFFF_FFFF


class Writer:
    """Puts payloads of one topic. The last of a latched topic is kept for late readers.

    Bulk samples are dropped where they can't be sent at once: no reader may hold the camera back. Small ones
    wait their turn, and at most until the link to a reader that stopped is cut.
    """

    def __init__(self, session: zenoh.Session, topic: Topic, key: str) -> None:
        self._lock = threading.Lock()
        self._sequence = 0
        self._latched: zenoh.ext.AdvancedPublisher | None = None
        self._plain: zenoh.Publisher | None = None
        quality: dict[str, Any] = {
            "encoding": zenoh.Encoding.APPLICATION_PROTOBUF.with_schema(codec.schema(topic).name),
            "congestion_control": zenoh.CongestionControl.DROP if topic.bulk else zenoh.CongestionControl.BLOCK,
            "priority": zenoh.Priority.DATA if topic.bulk else zenoh.Priority.DATA_HIGH,
            "express": topic.bulk,
        }
        if topic.latched:
            self._latched = declare_advanced_publisher(
                session,
                key,
                cache=CacheConfig(1),
                sample_miss_detection=MissDetectionConfig(heartbeat=None, sporadic_heartbeat=1.0),
                publisher_detection=True,
                **quality,
            )
        else:
            self._plain = session.declare_publisher(key, **quality)

    def put(self, payload: zenoh.ZBytes | bytes) -> None:
        if self._latched is not None:
            self._latched.put(payload)
        elif self._plain is not None:
            with self._lock:
                source = zenoh.SourceInfo(self._plain.id, self._sequence)
                self._sequence = (self._sequence + 1) & _SEQUENCE_MASK
                self._plain.put(payload, source_info=source)
