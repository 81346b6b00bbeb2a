"""The relay: what this host and the others have for each other, carried over the network.

Towards this host it is a reader and a writer like any other, on the loopback, with shared memory. Towards the
others it has a line to the router for every host that it sends to, so that a host that takes nothing holds up
nobody but itself.
"""

from __future__ import annotations

import json
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final

from pydantic import Field

from endo3d.schemas import codec, topics
from endo3d.schemas.messages import LogLine, Message, Status
from endo3d.schemas.topics import Topic
from endo3d.services.lanes.clock import Exchange, Offset
from endo3d.services.lanes.incoming import Incoming, Ordered
from endo3d.services.lanes.outgoing import (
    LARGE,
    PACKED,
    Changes,
    Every,
    Sender,
    looked_at_hz,
    newest_of,
    share_of,
    whole,
)
from endo3d.services.lanes.shards import PIECE_FRAMES, Shares
from endo3d.services.runtime import graph, hosts, stack_file
from endo3d.services.runtime.access import TAKEN, clock_key, lane_key
from endo3d.services.runtime.errors import UserError
from endo3d.services.runtime.hosts import RELAY, Lane, Role
from endo3d.services.runtime.identity import Identity, identity_of
from endo3d.services.runtime.network import Line
from endo3d.services.runtime.service import Config, Gateway, Refused, Sample
from endo3d.services.runtime.tally import Tally

if TYPE_CHECKING:
    from endo3d.services.runtime.bus import Bus

log = logging.getLogger(__name__)

_TICK_S: Final = 0.05
_PING_S: Final = 1.0
_SNAPSHOT_S: Final = 5.0
"""A host whose link comes and goes gets the whole map so often at most."""
_ANSWER_S: Final = 10.0


class RelayConfig(Config):
    rig: str = ""
    stack_toml: str = ""
    host: str = ""
    keys: Path = Path()
    piece_frames: int = Field(PIECE_FRAMES, ge=4)
    """Of a shared decoder: frames that one host decodes before the next one's turn."""


class Relay(Gateway[RelayConfig]):
    """Carries topics, statuses, logs, commands and who is there between this host and the others."""

    Config = RelayConfig
    nice = 5
    """It may skip what others only look at; the rig's own services may not."""
    clock: ClassVar[Callable[[], int]] = time.time_ns

    def __init__(self, config: RelayConfig) -> None:
        super().__init__(config)
        self.stack = stack_file.loads(config.stack_toml).on(config.host)
        self.placement = self.stack.placement
        wiring = graph.of(self.stack)
        self.lanes = hosts.lanes(self.placement, wiring)
        self.here = frozenset(self.placement.on(config.host).values())
        others = [host for host in self.placement.hosts if host != config.host]
        self.elsewhere = {name: host for host in others for name in self.placement.on(host).values()}
        """Name of a service -> its host, of all the others."""
        writers = {topic.name: entry.name for entry in wiring.entries for topic in entry.kind.writes}
        self._writers = writers
        self._seen: deque[tuple[str, bool]] = deque()
        """Who came or went, on this host or another."""
        self._there: set[str] = set()
        self._alive_here: set[str] = set()
        self._offset = Offset()
        self._tally = Tally()
        self._senders: dict[str, list[Sender]] = {}
        self._lines: list[Line] = []
        self._ordered: dict[str, Ordered] = {}
        self._shares: Shares | None = None
        self._newcomers: set[str] = set()
        self._snapshots_s: dict[str, float] = {}
        self._closing = threading.Event()
        self._attendant = threading.Thread(target=self._attend, name="attend", daemon=True)
        self._bytes_before: dict[str, tuple[float, int]] = {}
        self._bus: Bus | None = None
        self._identity: Identity | None = None

    @property
    def role(self) -> Role:
        return self.placement.hosts[self.config.host].role

    def open(self) -> None:
        """Finds the certificate. Raises ``UserError``."""
        self._identity = identity_of(self.config.host, self.role, self.config.keys)

    def connect(self, bus: Bus) -> None:
        self._bus = bus
        for service in self.elsewhere:
            bus.serve(partial(self._command_there, service), service)
        bus.watch_alive(self._see_here)
        self._start_line(self._join)
        for lane in self.lanes:
            if lane.sender == self.config.host:
                self._start_line(partial(self._send, lane))
        self._attendant.start()

    def values(self) -> Mapping[str, float]:
        """Of the clock of the rig against ours, and of the lines to the other hosts."""
        best, now_s = self._offset.best, time.monotonic()
        figures: dict[str, float] = {}
        if best is not None:
            figures |= {"clock_offset_ms": best.offset_ns / 1e6, "round_trip_ms": best.round_trip_ns / 1e6}
        for host, senders in self._senders.items():
            sent = sum(sender.sent_bytes for sender in senders)
            before_s, before = self._bytes_before.get(host, (now_s - 1.0, 0))
            self._bytes_before[host] = now_s, sent
            figures[f"mbit_s to {host}"] = 8e-6 * (sent - before) / max(now_s - before_s, 1e-3)
        return figures

    def losses(self) -> Mapping[str, int]:
        """What was lost between hosts: waiting for a link, or on it."""
        lost = self._tally.snapshot()[2]
        for host, senders in self._senders.items():
            lost |= {f"{sender.topic.name}:no room to {host}": sender.waiting.lost for sender in senders}
        lost |= {f"{topic}:late": ordered.late for topic, ordered in self._ordered.items()}
        return {cause: count for cause, count in lost.items() if count}

    def trouble(self) -> str:
        if not self._lines or not self._lines[0].up:
            return f"no line to the router at {self.placement.endpoint}; does it run on {self.placement.router}?"
        feeding = {lane.sender for lane in self.lanes if lane.receiver == self.config.host and _streams(lane)}
        missing = sorted(host for host in feeding if f"{RELAY}-{host}" not in self._there)
        return f"{', '.join(missing)}: not there" if missing else ""

    def close(self) -> None:
        self._closing.set()
        for sender in self._every_sender():
            sender.close()
        for line in self._lines:
            line.close()
        if self._attendant.is_alive():
            self._attendant.join()

    # ---------------------------------------------------------------- lines

    def _start_line(self, opened: Callable[[Line], None]) -> None:
        assert self._identity is not None
        line = Line(self.placement.endpoint, self._identity, opened)
        self._lines.append(line)
        line.start()

    def _join(self, line: Line) -> None:
        """The line that what comes from the others comes on: data, commands, who is there, what time it is."""
        rig = self.config.rig
        for lane in self.lanes:
            if lane.receiver == self.config.host:
                for topic in lane.topics:
                    self._receive(line, lane, topic)
            if lane.sender == self.config.host:
                line.listen(lane_key(rig, lane.receiver, lane.sender, TAKEN), partial(self._hear_taken, lane.receiver))
        if self.role is not Role.VIEWER:
            for name in self.here:
                line.answer(topics.control_key(rig, name, "*"), self._command_here)
        if self.role is Role.RIG:
            line.answer(clock_key(rig, self.config.host), lambda key, payload: str(self._now_ns()).encode())
        line.watch(topics.alive_key(rig, "*"), self._see_there)
        for name in tuple(self._alive_here):
            line.show(topics.alive_key(rig, name))
        log.info("joined the other hosts at %s as %s", self.placement.endpoint, self.role)

    def _receive(self, line: Line, lane: Lane, topic: Topic) -> None:
        assert self._bus is not None
        publish: Callable[[Message], None] = self._bus.publish
        if topic.bulk and len(self.placement.services[self._writers[topic.name]]) > 1:
            publish = self._ordered.setdefault(topic.name, Ordered(publish)).publish
        name = self._name_on_lane(lane, topic)
        speaks_for = frozenset(self.placement.on(lane.sender).values())
        incoming = Incoming(topic, publish, self._tally, speaks_for=speaks_for, packed=name == PACKED)
        if topic in LARGE:
            say = line.sender(lane_key(self.config.rig, lane.receiver, lane.sender, TAKEN), large=False)
            incoming.taken = partial(say, topic.name.encode())
        key = lane_key(self.config.rig, lane.sender, lane.receiver, name)
        line.receive(key, replace(topic, latched=False), incoming.take, self._tally)

    def _send(self, lane: Lane, line: Line) -> None:
        """A line of its own for every other host, for all that goes there."""
        senders = [self._sender(lane, topic, line) for topic in lane.topics]
        self._senders[lane.receiver] = senders
        for sender in senders:
            sender.start()
        self._newcomers.add(lane.receiver)

    def _sender(self, lane: Lane, topic: Topic, line: Line) -> Sender:
        assert self._bus is not None
        preview = self.placement.hosts[lane.receiver].preview
        key = lane_key(self.config.rig, lane.sender, lane.receiver, self._name_on_lane(lane, topic))
        put = line.sender(key, large=topic in LARGE)
        newest_hz = None
        if topic.per_service:
            sender = Sender(topic, Every(topic.depth, self._report), put)
        elif topic == topics.FRAME and lane.shared:
            sender = Sender(topic, share_of(lane.receiver, self._shares_of(lane)), put)
        elif topic == topics.MAP and preview is not None:
            sender = Sender(topic, Changes(), put, preview.map_hz)
        elif topic.bulk and not self._is_shared(topic):
            newest_hz = looked_at_hz(topic, preview)
            sender = Sender(topic, newest_of(topic, preview), put)
        else:
            sender = Sender(topic, Every(topic.depth, whole), put)
        self._bus.subscribe_encoded(topic, sender.add, newest_hz=newest_hz)
        return sender

    def _hear_taken(self, host: str, topic: bytes) -> None:
        for sender in self._senders.get(host, ()):
            if sender.topic.name.encode() == topic:
                sender.taken()

    def _name_on_lane(self, lane: Lane, topic: Topic) -> str:
        reduced = self.placement.hosts[lane.receiver].preview is not None and not lane.shared
        return PACKED if topic == topics.FRAME and reduced else topic.name

    def _is_shared(self, topic: Topic) -> bool:
        """Written by several hosts, of which this is one: all of it crosses."""
        return len(self.placement.services[self._writers[topic.name]]) > 1

    def _shares_of(self, lane: Lane) -> Shares:
        """The same for all lanes: every piece has one owner."""
        if self._shares is None:
            self._shares = Shares(
                lane.shared, lambda host: lane.shared[host] in self._there, self.config.piece_frames
            )
        return self._shares

    def _report(self, sample: Sample) -> bytes | None:
        """A status or log line of this host, stamped by the rig's clock."""
        if sample.source not in self.here:
            return None
        message = codec.decode(sample.topic, sample.payload)
        assert isinstance(message, Status | LogLine)
        return codec.encode(replace(message, stamp_ns=message.stamp_ns + self._offset.offset_ns))

    # ---------------------------------------------------------------- commands

    def _command_there(self, service: str, verb: str, parameters: Mapping[str, Any]) -> Mapping[str, Any]:
        """A command given on this host to a service of another."""
        if self.role is Role.VIEWER:
            raise Refused(f"{self.config.host} may look, not command; its certificate is a viewer's")
        key = topics.control_key(self.config.rig, service, verb)
        answer = self._lines[0].ask(key, json.dumps(dict(parameters)).encode(), _ANSWER_S)
        if answer is None:
            raise Refused(f"{service} on {self.elsewhere[service]} does not answer; endo3d top shows who is there")
        reply: dict[str, Any] = json.loads(answer)
        return reply

    def _command_here(self, key: str, payload: bytes) -> bytes:
        """A command given on another host to a service of this one."""
        assert self._bus is not None
        *_, service, verb = key.split("/")
        try:
            parameters = json.loads(payload)
        except ValueError as error:
            raise Refused(f"the parameters are no JSON: {error}") from None
        if not isinstance(parameters, dict):
            raise Refused("the parameters are a JSON object, name -> value")
        try:
            return json.dumps(self._bus.call(service, verb, parameters, 0.8 * _ANSWER_S)).encode()
        except UserError as error:
            raise Refused(str(error)) from None

    # ---------------------------------------------------------------- who is there

    def _see_here(self, service: str, there: bool) -> None:
        if service in self.here:
            self._seen.append((service, there))

    def _see_there(self, key: str, there: bool) -> None:
        service = key.rpartition("/")[2]
        if service in self.elsewhere:
            self._seen.append((service, there))

    def _pass_on(self, service: str, there: bool) -> None:
        """Who is here is shown there, and the other way round.

        Not from within zenoh's callbacks: a line that is held up would hold up this host's own mesh.
        """
        if service in self.here:
            self._show(service, there)
        else:
            self._mirror(service, there)

    def _show(self, service: str, there: bool) -> None:
        (self._alive_here.add if there else self._alive_here.discard)(service)
        line, key = self._lines[0] if self._lines else None, topics.alive_key(self.config.rig, service)
        if line is not None and line.up:
            (line.show if there else line.hide)(key)

    def _mirror(self, service: str, there: bool) -> None:
        assert self._bus is not None
        (self._there.add if there else self._there.discard)(service)
        (self._bus.declare_alive if there else self._bus.undeclare_alive)(service)
        if there and service == f"{RELAY}-{self.elsewhere[service]}":
            self._newcomers.add(self.elsewhere[service])

    # ---------------------------------------------------------------- now and then

    def _attend(self) -> None:
        ping_at_s = 0.0
        while not self._closing.wait(_TICK_S):
            while self._seen:
                self._pass_on(*self._seen.popleft())
            for ordered in tuple(self._ordered.values()):
                ordered.attend()
            if time.monotonic() >= ping_at_s:
                ping_at_s = time.monotonic() + _PING_S
                self._ping()
                for host in tuple(self._newcomers):
                    self._newcomers.discard(host)
                    self._welcome(host)

    def _ping(self) -> None:
        """What time is it on the rig?"""
        if self.config.host == self.placement.router:
            return
        asked_ns = self._now_ns()
        answer = self._lines[0].ask(clock_key(self.config.rig, self.placement.router), b"", _PING_S)
        answered_ns = self._now_ns()
        if answer is not None and answer.isdigit():
            self._offset.add(Exchange(asked_ns, int(answer), answered_ns))

    def _welcome(self, host: str) -> None:
        """Somebody new, or back: what was said before is said once more."""
        for sender in self._senders.get(host, []):
            sender.repeat()
            if sender.topic == topics.MAP:
                self._send_whole_map(host)

    def _send_whole_map(self, host: str) -> None:
        assert self._bus is not None
        now_s = time.monotonic()
        if now_s < self._snapshots_s.get(host, -_SNAPSHOT_S) + _SNAPSHOT_S:
            self._newcomers.add(host)  # later
            return
        self._snapshots_s[host] = now_s
        try:
            self._bus.call(self._writers[topics.MAP.name], "snapshot", {}, 1.0)
        except (Refused, UserError) as error:
            log.info("no whole map for %s: %s", host, error)

    def _now_ns(self) -> int:
        return type(self).clock()

    def _every_sender(self) -> list[Sender]:
        return [sender for senders in self._senders.values() for sender in senders]


def _streams(lane: Lane) -> bool:
    """Whether more crosses than how the services do."""
    return any(not topic.per_service for topic in lane.topics)
