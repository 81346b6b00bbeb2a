"""A publication: one zenoh publisher, its samples numbered so that readers can count what they missed."""

from __future__ import annotations

import threading
from typing import Final

import zenoh
from zenoh.ext import CacheConfig, MissDetectionConfig, declare_advanced_publisher

from endo3d.schemas import codec
from endo3d.schemas.topics import Topic

_SEQUENCE_MASK: Final = 0xFFFF_FFFF


class Writer:
    """Puts payloads of one topic, never waiting for a reader; the last of a latched topic is kept."""

    def __init__(self, session: zenoh.Session, topic: Topic, key: str) -> None:
        encoding = zenoh.Encoding.APPLICATION_PROTOBUF.with_schema(codec.schema(topic).name)
        self._lock = threading.Lock()
        self._sequence = 0
        self._latched: zenoh.ext.AdvancedPublisher | None = None
        self._plain: zenoh.Publisher | None = None
        if topic.latched:
            self._latched = declare_advanced_publisher(
                session,
                key,
                encoding=encoding,
                cache=CacheConfig(1),
                sample_miss_detection=MissDetectionConfig(heartbeat=None, sporadic_heartbeat=1.0),
                publisher_detection=True,
            )
        else:
            self._plain = session.declare_publisher(
                key,
                encoding=encoding,
                congestion_control=zenoh.CongestionControl.DROP,
                express=True,
            )

    def put(self, payload: zenoh.ZBytes | bytes) -> None:
        if self._latched is not None:
            self._latched.put(payload)
        elif self._plain is not None:
            with self._lock:
                source = zenoh.SourceInfo(self._plain.id, self._sequence)
                self._sequence = (self._sequence + 1) & _SEQUENCE_MASK
                self._plain.put(payload, source_info=source)
