"""The way out: what of a topic crosses to another host, in what form, and where it waits for the link.

It waits in plain memory, never in the rig's shared memory: a link that is slow, or cut, costs the rig nothing.
And it waits here, not in the router, which would make others wait: of a large topic the far host has to have
taken a message before the next but one is sent.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Final, Protocol

from endo3d.schemas import codec, topics
from endo3d.schemas.messages import Cloud, DepthMap, Frame, MapDelta, Message
from endo3d.schemas.topics import Topic
from endo3d.services.lanes.preview import MapChanges, packed_frame, thinned_cloud, thinned_depth
from endo3d.services.lanes.shards import Shares
from endo3d.services.runtime.hosts import Preview
from endo3d.services.runtime.service import Sample

LARGE: Final = (topics.FRAME, topics.CLOUD, topics.DEPTH, topics.MAP)
PACKED: Final = "frame.jpeg"
"""Last part of the key of frames that hold a JPEG file: no picture until the far end unpacks them."""


UNDER_WAY: Final = 2
"""Messages of a large topic that may be on their way: one is sent while the other is unpacked."""
FORGOTTEN_S: Final = 2.0
"""A message of which nothing is heard for so long is lost."""


class Waiting(Protocol):
    """What waits to be sent: one thread adds, another takes."""

    lost: int

    def add(self, sample: Sample) -> None:
        """Takes a sample, if it is to cross; keeps nothing of shared memory."""

    def ready(self) -> bool:
        """Whether something waits."""

    def take(self) -> bytes | None:
        """The next payload, None when it turns out that there is nothing to send."""


class Every:
    """Each sample in turn; beyond ``depth`` the oldest is lost."""

    def __init__(self, depth: int, form: Callable[[Sample], bytes | None]) -> None:
        """``form`` gives the payload to send; None: this sample does not cross."""
        self.lost = 0
        self._form = form
        self._payloads: deque[bytes] = deque(maxlen=depth)

    def add(self, sample: Sample) -> None:
        payload = self._form(sample)
        if payload is not None and sample.valid():
            self.lost += len(self._payloads) == self._payloads.maxlen
            self._payloads.append(payload)

    def ready(self) -> bool:
        return bool(self._payloads)

    def take(self) -> bytes | None:
        return self._payloads.popleft() if self._payloads else None


class Newest:
    """One sample at a time: while it waits, no other is even copied."""

    def __init__(self, form: Callable[[Sample], bytes]) -> None:
        self.lost = 0
        self._form = form
        self._payload: bytes | None = None

    def add(self, sample: Sample) -> None:
        if self._payload is None:
            payload = self._form(sample)
            if sample.valid():
                self._payload = payload

    def ready(self) -> bool:
        return self._payload is not None

    def take(self) -> bytes | None:
        payload, self._payload = self._payload, None
        return payload


class Changes:
    """What changed in the map since the last payload."""

    def __init__(self) -> None:
        self.lost = 0
        self._changes = MapChanges()
        self._some = False
        self._lock = threading.Lock()

    def add(self, sample: Sample) -> None:
        delta = codec.decode(topics.MAP, sample.payload)
        assert isinstance(delta, MapDelta)
        with self._lock:
            self._changes.add(delta)
            self._some = True

    def ready(self) -> bool:
        return self._some

    def take(self) -> bytes | None:
        with self._lock:
            delta, self._some = self._changes.take(), False
        return codec.encode(delta) if delta is not None else None


class Sender(threading.Thread):
    """Puts what waits, one payload at a time."""

    def __init__(self, topic: Topic, waiting: Waiting, put: Callable[[bytes], None], rate_hz: float = math.inf) -> None:
        """``put`` may wait for the link; ``rate_hz`` is the most it is called."""
        super().__init__(name=f"send {topic.name}", daemon=True)
        self.topic = topic
        self.waiting = waiting
        self.sent_bytes = 0
        self._put = put
        self._period_s = 1.0 / rate_hz
        self._last: bytes | None = None
        self._under_way = 0
        self._again = False
        self._closing = False
        self._changed = threading.Condition()

    def add(self, sample: Sample) -> None:
        """A sample to be sent, if it is to cross."""
        self.waiting.add(sample)
        with self._changed:
            self._changed.notify()

    def repeat(self) -> None:
        """Somebody new listens: what is latched is sent once more."""
        if self.topic.latched:
            with self._changed:
                self._again = True
                self._changed.notify()

    def taken(self) -> None:
        """The far host has taken a message."""
        with self._changed:
            self._under_way = max(0, self._under_way - 1)
            self._changed.notify()

    def run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closing or self._again or self.waiting.ready())
                if not self._changed.wait_for(lambda: self._closing or self._under_way < UNDER_WAY, FORGOTTEN_S):
                    self._under_way = 0
                if self._closing:
                    return
                again, self._again = self._again, False
                self._under_way += self.topic in LARGE
            began_s = time.monotonic()
            payload = self.waiting.take() or (self._last if again else None)
            if payload is not None:
                self._put(payload)
                self.sent_bytes += len(payload)
                self._last = payload if self.topic.latched else None
            with self._changed:
                self._changed.wait_for(lambda: self._closing, max(0.0, began_s + self._period_s - time.monotonic()))

    def close(self) -> None:
        """Ends after the payload under way; what waits is not sent any more."""
        with self._changed:
            self._closing = True
            self._changed.notify()


def newest_of(topic: Topic, preview: Preview | None) -> Waiting:
    """A bulk topic for a host that looks on: the newest sample, whole or reduced."""
    return Newest(whole if preview is None else lambda sample: _reduced(sample, preview))


def looked_at_hz(topic: Topic, preview: Preview | None) -> float:
    """How many samples of a bulk topic a second are looked at for a host that looks on."""
    if preview is None:
        return math.inf
    return preview.image_hz if topic == topics.FRAME else preview.cloud_hz


def share_of(host: str, shares: Shares) -> Waiting:
    """A decoder's share of the frames, every one of them."""

    def form(sample: Sample) -> bytes | None:
        frame = codec.decode(topics.FRAME, sample.payload)
        assert isinstance(frame, Frame)
        return whole(sample) if shares.takes(host, frame) else None

    return Every(topics.FRAME.depth, form)


def lane_name(topic: Topic, preview: Preview | None) -> str:
    """The topic's part of the key between two hosts."""
    return PACKED if preview is not None and topic == topics.FRAME else topic.name


def whole(sample: Sample) -> bytes:
    """A sample as it is, copied."""
    return bytes(sample.payload)


def _reduced(sample: Sample, preview: Preview) -> bytes:
    return codec.encode(_thinned(codec.decode(sample.topic, sample.payload), preview))


def _thinned(message: Message, preview: Preview) -> Message:
    match message:
        case Frame():
            return packed_frame(message, preview.image_step, preview.jpeg_quality)
        case Cloud():
            return thinned_cloud(message, preview.cloud_step)
        case DepthMap():
            return thinned_depth(message, preview.cloud_step)
    return message
