"""The way in: what another host sent becomes a message here, if it is one, and if it is that host's to say."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection

from endo3d.schemas import codec
from endo3d.schemas.messages import Cloud, DepthMap, Frame, LogLine, Message, Status
from endo3d.schemas.topics import Topic
from endo3d.services.lanes.order import InOrder
from endo3d.services.lanes.preview import unpacked_frame
from endo3d.services.runtime.service import Sample
from endo3d.services.runtime.tally import Tally


class Incoming:
    """A topic from one host."""

    def __init__(
        self,
        topic: Topic,
        publish: Callable[[Message], None],
        tally: Tally,
        *,
        speaks_for: Collection[str],
        packed: bool = False,
    ) -> None:
        """speaks_for: the services of that host; packed: frames hold JPEG files."""
        self.taken: Callable[[], object] = bool
        """Told of each message, when it has been taken."""
        self._topic = topic
        self._publish = publish
        self._tally = tally
        self._speaks_for = speaks_for
        self._packed = packed

    def take(self, sample: Sample) -> None:
        """Publishes a sample here; what is malformed, or of a service of another host, is counted."""
        try:
            self._take(sample)
        finally:
            self.taken()

    def _take(self, sample: Sample) -> None:
        try:
            message = codec.decode(self._topic, sample.payload)
            if self._packed and isinstance(message, Frame):
                message = unpacked_frame(message)
        except codec.Malformed:
            self._tally.drop(self._topic.name, "malformed")
            return
        if isinstance(message, Status | LogLine) and message.service not in self._speaks_for:
            self._tally.drop(self._topic.name, "forged")
            return
        self._publish(message)


class Ordered:
    """Publishes the results of several decoders in the order of their frames."""

    def __init__(self, publish: Callable[[Message], None]) -> None:
        self._publish = publish
        self._order = InOrder()
        self._lock = threading.Lock()

    @property
    def late(self) -> int:
        return self._order.late

    def publish(self, result: Message) -> None:
        """A result of any of them."""
        assert isinstance(result, Cloud | DepthMap)
        with self._lock:
            for message in self._order.add(result, time.monotonic_ns()):
                self._publish(message)

    def attend(self) -> None:
        """To be called now and then: gives up waiting for what does not come."""
        with self._lock:
            for message in self._order.due(time.monotonic_ns()):
                self._publish(message)
