"""Malformed and hostile messages on every key of a rig, as many as are asked for, drawn by hypothesis.

What is sent is what a broken or malicious program on the same bus could send: noise, and genuine messages cut,
stretched and overwritten. A forged message that is well-formed is no fault of a reader; against that there are
certificates and access control (docs/deployment.md). Of those only what a confused, not a lying, neighbour
would send is tried: ``foreign``.
"""

from __future__ import annotations

import json
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import TypeVar

import numpy as np
import zenoh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from endo3d.schemas import codec, topics
from endo3d.schemas.messages import Cloud, Frame, Message, Mode
from endo3d.schemas.topics import Topic
from endo3d.services.runtime.session import meeting_ports, open_session

T = TypeVar("T")

VERBS = ("mode", "exposure", "seek", "rate", "nonsense")
"""Those that change nothing when they are refused."""
HEADER_BYTES = 600
"""Where a message's fields stand; behind them is the array, in which every byte is valid."""
NOISE = st.binary(max_size=400)
PARAMETERS = st.one_of(
    NOISE,
    st.recursive(
        st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=20)),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
        max_leaves=8,
    ).map(lambda value: json.dumps(value).encode(errors="replace")),
)


class Attacker:
    """A stranger's session on the loopback of a rig. A context manager."""

    def __init__(self, rig: str) -> None:
        self._rig = rig
        self._session = open_session(meeting_ports(rig), shared_memory=False)
        self._genuine: dict[str, bytes] = {}
        self._readers = [
            self._session.declare_subscriber(topic.key(rig), partial(self._hear, topic.name))
            for topic in topics.TOPICS
        ]
        self._lock = threading.Lock()

    def __enter__(self) -> Attacker:
        return self

    def __exit__(self, *_: object) -> None:
        self._session.close()

    def _hear(self, name: str, sample: zenoh.Sample) -> None:
        if name not in self._genuine:
            self._genuine[name] = sample.payload.to_bytes()

    def malformed(self, count: int) -> Counter[str]:
        """``count`` malformed messages on the key of every topic; how many were sent, by topic."""
        for reader in self._readers:
            reader.undeclare()
        sent: Counter[str] = Counter()
        for topic in topics.TOPICS:
            for payload in drawn(broken(self._genuine.get(topic.name, b"")), count):
                if not _is_well_formed(topic, payload):
                    self._session.put(topic.key(self._rig, "stranger"), payload)
                    sent[topic.name] += 1
        return sent

    def foreign(self) -> int:
        """Well-formed messages that do not belong to this scan; how many were sent."""
        sent = 0
        for message in _foreign(self._genuine):
            self._session.put(topics.of(message).key(self._rig, "stranger"), codec.encode(message))
            sent += 1
        return sent

    def commands(self, services: Sequence[str], count: int) -> tuple[int, int]:
        """Nonsense to every service; how many were sent, and how many refused with a reason."""
        sent = refused = 0
        for service in services:
            for verb, payload in drawn(st.tuples(st.sampled_from(VERBS), PARAMETERS), count):
                key = topics.control_key(self._rig, service, verb)
                replies = list(self._session.get(key, payload=payload, timeout=2.0))
                sent += 1
                refused += any(reply.err is not None for reply in replies)
        return sent, refused


def drawn(strategy: st.SearchStrategy[T], count: int) -> list[T]:
    """``count`` examples, the same ones every time."""
    examples: list[T] = []

    @settings(
        max_examples=count, database=None, deadline=None, derandomize=True, suppress_health_check=[*HealthCheck]
    )
    @given(strategy)
    def take(example: T) -> None:
        examples.append(example)

    take()
    return examples


@st.composite
def broken(draw: st.DrawFn, genuine: bytes) -> bytes:
    """Noise, or a genuine message after an accident."""
    if not genuine or draw(st.booleans()):
        return draw(NOISE)
    head = bytearray(genuine[:HEADER_BYTES])
    for place, value in draw(st.lists(st.tuples(st.integers(0, len(head) - 1), st.integers(0, 255)), max_size=12)):
        head[place] = value
    rest = genuine[HEADER_BYTES:] if len(genuine) < 1 << 16 else b""
    whole = bytes(head) + rest
    return whole[: draw(st.integers(0, len(whole)))] + draw(NOISE)


def _is_well_formed(topic: Topic, payload: bytes) -> bool:
    try:
        codec.decode(topic, payload)
    except codec.Malformed:
        return False
    return True


def _foreign(genuine: dict[str, bytes]) -> Iterator[Message]:
    if "frame" in genuine:
        frame = codec.decode(topics.FRAME, genuine["frame"])
        assert isinstance(frame, Frame)
        yield replace(frame, image=np.zeros((1, 1), np.uint8))
        yield replace(frame, image=np.full((37, 61), 65535, np.uint16))
        yield replace(frame, epoch=2**63, sequence=2**63)
        yield replace(frame, slot=-1)
        yield replace(frame, slot=10**6)
        yield replace(frame, pattern_set="conventional f=0/0/0 steps=0/0/0")
        yield replace(frame, stamp_ns=-(2**62), exposure_us=float("nan"))
    if "cloud" in genuine:
        cloud = codec.decode(topics.CLOUD, genuine["cloud"])
        assert isinstance(cloud, Cloud)
        for value in (np.nan, np.inf, 1e30):
            points = np.zeros((3, 5), cloud.points.dtype)
            for axis in "xyz":
                points[axis] = value
            yield replace(cloud, points=points)
    if "mode" in genuine:
        mode = codec.decode(topics.MODE, genuine["mode"])
        assert isinstance(mode, Mode)
        yield replace(mode, pattern_set="nonsense", frame_period_ns=0)
