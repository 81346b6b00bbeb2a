"""The bus: messages and commands between the processes of a rig, over zenoh and shared memory.

Large arrays travel without a copy: ``loan`` lends an array that lies in shared memory already, ``publish``
seals it in place, and a reader's message is a view of the very same memory. Where that is not to be had
(memory locking forbidden, another zenoh release) the bus copies, and says so in ``note``.
"""

from __future__ import annotations

import atexit
import json
import logging
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from importlib.metadata import version
from types import TracebackType
from typing import Any, Final, Self

import zenoh
from numpy.typing import DTypeLike, NDArray
from zenoh.handlers import FifoChannel

from endo3d.schemas import codec, topics
from endo3d.schemas.messages import LogLine, Message, Status
from endo3d.schemas.topics import Topic
from endo3d.services.runtime import mapping, pool, priority, segments
from endo3d.services.runtime.errors import UserError
from endo3d.services.runtime.memory import Memory
from endo3d.services.runtime.reader import Reader
from endo3d.services.runtime.service import Exhausted, Refused, Sample, plain_loan
from endo3d.services.runtime.session import lockable, meeting_ports, open_session
from endo3d.services.runtime.shm_view import View
from endo3d.services.runtime.tally import Tally
from endo3d.services.runtime.writer import Writer

log = logging.getLogger(__name__)

_ASK_AGAIN_S: Final = 0.02

atexit.register(segments.unlink_unused)

Command = Callable[[str, Mapping[str, Any]], Mapping[str, Any]]
"""(verb, parameters) -> reply; raises ``Refused``."""


class Bus:
    """One process's place on the bus of a rig. Make it with ``Bus.open``; it is a context manager."""

    def __init__(
        self, rig: str, name: str, session: zenoh.Session, shared_memory: bool, view: View | None, note: str
    ) -> None:
        self.rig = rig
        self.name = name
        self.note = note
        """Why this process is slower than it could be; empty when it isn't."""
        self.tally = Tally()
        self._session = session
        self._memory = Memory(view, self._offer_pool) if shared_memory else None
        self._view = view
        self._writers: dict[str, Writer] = {}
        self._readers: list[Reader] = []
        self._queryables: list[zenoh.Queryable[Any]] = []
        self._declared: list[object] = []
        self._tokens: dict[str, zenoh.LivelinessToken] = {}
        self._named: set[str] = set()
        self._lock = threading.Lock()

    @classmethod
    def open(
        cls,
        rig: str,
        *,
        name: str = "",
        port: int | None = None,
        shm_mb: int = 512,
        shared_memory: bool = True,
        settings: Mapping[str, Any] | None = None,
    ) -> Self:
        """Join a rig's bus as ``name``.

        port: the first of the loopback ports where the rig meets; by default it follows from the name.
        shm_mb: what all pools of the rig together may take, and every process must be able to lock.
        settings: zenoh configuration over the built-in one, path -> value.
        Raises ``UserError`` with what to do.
        """
        note, view = "", None
        if not shared_memory:
            note = "shared memory is switched off: large messages go over the loopback network"
        elif not lockable(shm_mb << 20):
            shared_memory = False
            note = (
                f"may not lock {shm_mb} MB of memory: large messages go over the loopback network; "
                "raise the limit (ulimit -l unlimited, LimitMEMLOCK=infinity, --ulimit memlock=-1)"
            )
        else:
            try:
                view = priority.promptly(pool.self_test)
            except zenoh.ZError as error:
                shared_memory = False
                note = f"no shared memory ({error}): large messages go over the network; see endo3d doctor"
            else:
                if view is None:
                    note = f"no zero-copy view in zenoh {version('eclipse-zenoh')}: large messages are copied"
        if note:
            log.warning(note)
        session = priority.promptly(
            partial(open_session, meeting_ports(rig, port), shared_memory=shared_memory, settings=settings)
        )
        return cls(rig, name, session, shared_memory, view, note)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def stop_reading(self) -> None:
        """No more messages and commands; when it returns, all handlers have returned."""
        for service in tuple(self._tokens):
            self.undeclare_alive(service)
        for queryable in self._queryables:
            queryable.undeclare()
        for reader in self._readers:
            reader.close()
        self._queryables, self._readers = [], []

    def close(self) -> None:
        """Stop reading, then leave. Arrays that were loaned or received are void from now on."""
        self.stop_reading()
        if self._memory is not None:
            self._memory.settle()
            self._memory = None
        try:
            self._session.close()
        except zenoh.ZError as error:  # a connection attempt that hangs
            log.warning("leaving without waiting: %s", error)

    # ---------------------------------------------------------------- messages

    def loan(self, topic: Topic, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """An uninitialised array whose publication copies nothing; raises ``Exhausted``, counted.

        Write it before it is published, never after.
        """
        if self._memory is None:
            return plain_loan(topic, shape, dtype)
        try:
            return self._memory.lend(topic, shape, dtype)
        except Exhausted:
            self.tally.drop(topic.name, "exhausted")
            raise

    def publish(self, message: Message) -> None:
        """Put a message on its topic; counted and dropped when shared memory is exhausted."""
        topic = topics.of(message)
        try:
            payload = codec.encode(message) if self._memory is None else self._memory.payload(topic, message)
        except Exhausted:
            self.tally.drop(topic.name, "exhausted")
            return
        source = message.service if isinstance(message, Status | LogLine) else self.name
        self._writer(topic, topic.key(self.rig, source)).put(payload)
        self.tally.publish(topic.name)

    def subscribe(
        self, topic: Topic, handler: Callable[[Message], None], *, newest_hz: float | None = None
    ) -> None:
        """Call ``handler`` with the messages of ``topic``, in a thread of its own.

        ``newest_hz``: only the newest message each time, and at most so often. Otherwise ``topic.depth`` of them
        may wait, and what is missed beyond that is counted. Malformed messages are counted and dropped.
        """

        def deliver(sample: Sample) -> None:
            message = self._decoded(sample)
            if message is not None:
                handler(message)

        self.subscribe_encoded(topic, deliver, newest_hz=newest_hz)

    def subscribe_encoded(
        self, topic: Topic, handler: Callable[[Sample], None], *, newest_hz: float | None = None
    ) -> None:
        """The same with samples as they travelled."""
        if topic.bulk and self._view is not None:
            self._declared.append(
                mapping.map_offered(self._session, mapping.key(self.rig, topic), lambda: self._can_not_map(topic))
            )
        reader = Reader(self._session, topic.key(self.rig), topic, handler, self._view, self.tally, newest_hz)
        self._readers.append(reader)
        reader.start()

    def intact(self) -> bool:
        """Whether all shared memory that readers of this process still look at is what was sent.

        To ask before a result goes out: after a stop of this process its writers may have taken memory back.
        """
        return all(reader.intact() for reader in self._readers)

    # ---------------------------------------------------------------- commands

    def serve(self, handler: Command, service: str = "") -> None:
        """Answer commands to this process's service, one at a time, in a thread of its own.

        service: another one, that is reached through this process.
        """
        key = topics.control_key(self.rig, service or self.name, "*")
        queryable = self._session.declare_queryable(key, FifoChannel(16))
        self._queryables.append(queryable)
        threading.Thread(target=_answer_all, args=(queryable, handler), name="serve", daemon=True).start()

    def call(
        self, service: str, verb: str, parameters: Mapping[str, Any] | None = None, timeout_s: float = 5.0
    ) -> dict[str, Any]:
        """Command a service and return its reply.

        Raises ``Refused`` with the service's reason, ``UserError`` when it does not answer.
        """
        key = topics.control_key(self.rig, service, verb)
        payload = json.dumps(dict(parameters or {}))
        deadline = time.monotonic() + timeout_s
        while (left_s := deadline - time.monotonic()) > 0:
            for reply in self._session.get(
                key, payload=payload, encoding=zenoh.Encoding.APPLICATION_JSON, timeout=left_s
            ):
                if reply.ok is not None:
                    answer: dict[str, Any] = json.loads(reply.ok.payload.to_bytes())
                    return answer
                if reply.err is not None and reply.err.encoding == zenoh.Encoding.APPLICATION_JSON:
                    raise Refused(json.loads(reply.err.payload.to_bytes())["error"])
            time.sleep(_ASK_AGAIN_S)
        raise UserError(f"{service} does not answer on rig {self.rig}; is it running? (endo3d top)")

    # ---------------------------------------------------------------- who is there

    def declare_alive(self, service: str = "") -> None:
        """From now on others see this process's service, or another one that is reached through this process."""
        name = service or self.name
        if name not in self._tokens:
            self._tokens[name] = self._session.liveliness().declare_token(topics.alive_key(self.rig, name))

    def undeclare_alive(self, service: str) -> None:
        """That other one is gone."""
        if token := self._tokens.pop(service, None):
            token.undeclare()

    def alive(self) -> set[str]:
        """The services that are there now."""
        replies = self._session.liveliness().get(topics.alive_key(self.rig, "*"), timeout=1.0)
        return {_last_part(reply.ok.key_expr) for reply in replies if reply.ok is not None}

    def watch_alive(self, handler: Callable[[str, bool], None]) -> None:
        """Call ``handler(service, is_there)`` for all that are there, and whenever one comes or goes."""

        def deliver(sample: zenoh.Sample) -> None:
            handler(_last_part(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        self._session.liveliness().declare_subscriber(topics.alive_key(self.rig, "*"), deliver, history=True)

    # ---------------------------------------------------------------- within

    def _writer(self, topic: Topic, key: str) -> Writer:
        with self._lock:
            if key not in self._writers:
                self._writers[key] = Writer(self._session, topic, key)
            return self._writers[key]

    def _offer_pool(self, topic: Topic, piece: zenoh.ZBytes) -> None:
        self._declared.extend(mapping.offer(self._session, mapping.key(self.rig, topic), piece))

    def _can_not_map(self, topic: Topic) -> None:
        self.note = (
            f"{topic.name} does not arrive: its shared memory can't be mapped here; "
            "check memory locking and /dev/shm (endo3d doctor)"
        )
        log.error(self.note)

    def _decoded(self, sample: Sample) -> Message | None:
        try:
            return codec.decode(sample.topic, sample.payload)
        except codec.Malformed as error:
            name = sample.topic.name
            self.tally.drop(name, "malformed")
            if name not in self._named:
                self._named.add(name)
                log.warning("malformed messages on %s are dropped, the first: %s", name, error)
            return None


def _answer_all(queryable: zenoh.Queryable[Any], handler: Command) -> None:
    for query in queryable.handler:
        with query:  # the caller waits until the query is let go
            _answer(query, handler)


def _answer(query: zenoh.Query, handler: Command) -> None:
    verb = _last_part(query.key_expr)
    try:
        reply = handler(verb, _parameters(query.payload))
    except Refused as error:
        _refuse(query, str(error))
    except Exception as error:
        log.exception("command %s failed", verb)
        _refuse(query, f"{verb} failed: {error}")
    else:
        query.reply(query.key_expr, json.dumps(dict(reply)), encoding=zenoh.Encoding.APPLICATION_JSON)


def _parameters(payload: zenoh.ZBytes | None) -> Mapping[str, Any]:
    try:
        parameters = json.loads(payload.to_bytes()) if payload else {}
    except ValueError as error:
        raise Refused(f"the parameters are no JSON: {error}") from None
    if not isinstance(parameters, dict):
        raise Refused("the parameters are a JSON object, name -> value")
    return parameters


def _refuse(query: zenoh.Query, reason: str) -> None:
    query.reply_err(json.dumps({"error": reason}), encoding=zenoh.Encoding.APPLICATION_JSON)


def _last_part(key: zenoh.KeyExpr) -> str:
    return str(key).rsplit("/", 1)[-1]
