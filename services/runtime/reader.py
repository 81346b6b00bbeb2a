"""A subscription: a short ring of samples and the thread that works them off."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
import weakref
from collections.abc import Callable
from typing import Any, Final

import numpy as np
import zenoh
from numpy.typing import NDArray
from zenoh.ext import HistoryConfig, declare_advanced_subscriber
from zenoh.handlers import RingChannel

from endo3d.schemas.topics import Topic
from endo3d.services.runtime.service import Sample
from endo3d.services.runtime.shm_view import Chunk, View
from endo3d.services.runtime.tally import Tally

log = logging.getLogger(__name__)

_SEQUENCES: Final = 1 << 32
"""zenoh counts a writer's samples with 32 bits."""


class Reader(threading.Thread):
    """Takes samples of one topic. The ring drops its oldest when the work is slower than the writer: a reader
    never holds the writer back, and never holds more than ``topic.depth`` chunks of its memory.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        topic: Topic,
        deliver: Callable[[Sample], None],
        view: View | None,
        tally: Tally,
        newest_hz: float | None,
    ) -> None:
        """``newest_hz``: the ring holds one sample, and what it drops is skipped on purpose, not lost; between two
        samples this thread sleeps, so that those that nobody looks at cost nothing here.
        """
        super().__init__(name=f"read {topic.name}", daemon=True)
        self._topic = topic
        self._deliver = deliver
        self._view = view
        self._tally = tally
        self._newest = newest_hz is not None
        self._period_s = 1.0 / newest_hz if newest_hz is not None else 0.0
        self._due_s = 0.0
        self._closing = threading.Event()
        self._expected: dict[tuple[zenoh.ZenohId, int], int] = {}
        self._chunks: weakref.WeakSet[Chunk] = weakref.WeakSet()
        self._subscriber = _subscribe(session, key, topic, 1 if self._newest else topic.depth)
        self._ring = self._subscriber.handler  # fetched once: while it is undeclared nobody may touch a subscriber

    def run(self) -> None:
        with contextlib.suppress(zenoh.ZError):  # the ring is closed
            while True:
                self._take(self._ring.recv())  # in no variable: it would hold its memory
                if self._period_s and self._closing.wait(max(0.0, self._due_s - time.monotonic())):
                    break

    def close(self) -> None:
        """Ends the thread after the sample it works on."""
        self._closing.set()
        self._subscriber.undeclare()
        if threading.current_thread() is not self:
            self.join()

    def intact(self) -> bool:
        """Whether every piece of shared memory that is still looked at here is what was sent."""
        return all(chunk.is_valid() for chunk in tuple(self._chunks))

    def _take(self, sample: zenoh.Sample) -> None:
        self._due_s = time.monotonic() + self._period_s
        try:
            self._deliver_content(sample)
        except Exception:
            self._tally.drop(self._topic.name, "failed")
            log.exception("reading %s goes on after this", self._topic.name)

    def _deliver_content(self, sample: zenoh.Sample) -> None:
        received_ns = time.time_ns()
        topic = self._topic.name
        self._tally.receive(topic)
        missed = self._missed(sample)
        if missed and not self._newest:
            self._tally.drop(topic, "missed", missed)
        chunk, content = self._content(sample.payload)
        source = str(sample.key_expr).rsplit("/", 1)[-1] if self._topic.per_service else ""
        valid = chunk.is_valid if chunk is not None else lambda: True
        self._deliver(Sample(self._topic, source, content.data, received_ns, valid))

    def _content(self, payload: zenoh.ZBytes) -> tuple[Chunk | None, NDArray[np.uint8]]:
        """The payload's bytes, (size,) uint8, and the shared memory that they are a view of, if they are."""
        owner = payload.as_shm() if self._view is not None else None
        if owner is None or self._view is None:
            return None, np.frombuffer(payload.to_bytes(), np.uint8)
        chunk = self._view(owner, len(payload))
        self._chunks.add(chunk)
        return chunk, chunk.array()

    def _missed(self, sample: zenoh.Sample) -> int:
        """Samples of the same writer between the last one taken and this one."""
        source = sample.source_info
        if source is None:
            return 0
        writer = source.source_id.zid, source.source_id.eid
        sequence: int = source.source_sn
        missed = (sequence - self._expected.get(writer, sequence)) % _SEQUENCES
        self._expected[writer] = sequence + 1
        return missed if missed < _SEQUENCES // 2 else 0


def _subscribe(session: zenoh.Session, key: str, topic: Topic, depth: int) -> Any:
    """zenoh's subscriber, the advanced one for a latched topic."""
    ring: RingChannel[zenoh.Sample] = RingChannel(depth)
    if not topic.latched:
        return session.declare_subscriber(key, ring)
    return declare_advanced_subscriber(
        session, key, ring, history=HistoryConfig(detect_late_publishers=True, max_samples=1)
    )
