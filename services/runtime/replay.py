"""A log through the very steps of the services: no bus, clock or thread, so equal inputs give equal bits."""

from __future__ import annotations

import hashlib
import tempfile
from collections import Counter, deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from endo3d.schemas import codec, topics
from endo3d.schemas.messages import Message
from endo3d.schemas.topics import Topic
from endo3d.services.archive.entry import CALIBRATION_FILE, STACK_FILE, Attachment, entry_of
from endo3d.services.archive.facts import host_facts
from endo3d.services.archive.reader import Log, Record
from endo3d.services.archive.recording import Recording
from endo3d.services.runtime import stack_file
from endo3d.services.runtime.errors import UserError
from endo3d.services.runtime.hosts import RELAY, ROUTER
from endo3d.services.runtime.service import Service, Source, Tap
from endo3d.services.runtime.stack_file import Stack

CARRIED = frozenset({topics.MODE, topics.CAMERA, topics.PROJECTOR, topics.TRUTH})
"""What a log of results takes over from the log they were made of."""

AHEAD = 16
"""Records read ahead of the one being computed."""


class Result(NamedTuple):
    """What a service made of an input."""

    service: str
    message: Message
    cause: Record
    """The record of the log that it followed from."""


class Pipeline:
    """Services wired by what they read and write, run in one thread."""

    def __init__(self, services: Mapping[str, Service[Any]]) -> None:
        self.services = services
        self._readers: dict[Topic, list[str]] = {topic: [] for topic in topics.TOPICS}
        for name, service in services.items():
            for topic in service.reads:
                self._readers[topic].append(name)
        self.written = frozenset(topic for service in services.values() for topic in service.writes)
        """What the services produce."""
        self.inputs = frozenset(topic for topic, names in self._readers.items() if names) - self.written
        """What a log has to give."""

    def feed(self, message: Message) -> Iterator[tuple[str, Message]]:
        """One message in; yields (service, message) of all that follows from it, in the order of making."""
        waiting = deque([message])
        while waiting:
            now = waiting.popleft()
            for name in self._readers[topics.of(now)]:
                for made in self.services[name].step(now):
                    yield name, made
                    waiting.append(made)


@contextmanager
def stack_of(log: Log, stack: str | Path | None = None, overrides: Sequence[str] = ()) -> Iterator[Stack]:
    """The stack that made a log (or another), with the log's calibration and ``table.key=value`` overrides.

    Raises ``UserError`` when the log carries no stack file and none is given.
    """
    text = log.attachments.get(STACK_FILE, b"").decode()
    if stack is not None:
        described = stack_file.load(stack, overrides)
    elif text:
        described = stack_file.loads(text, overrides)
    else:
        raise UserError(f"{log.path} carries no stack file; name one with --stack")
    calibration = log.attachments.get(CALIBRATION_FILE)
    if calibration is None:
        yield described
        return
    with tempfile.TemporaryDirectory(prefix="endo3d-") as folder:
        head = Path(folder) / CALIBRATION_FILE
        head.write_bytes(calibration)
        yield replace(described, rig=described.rig.model_copy(update={"head": str(head)}))


@contextmanager
def pipeline_of(stack: Stack, only: Collection[str] = ()) -> Iterator[Pipeline]:
    """The services of a stack that compute (or ``only`` these), opened and warm.

    Sources, taps and those that write nothing don't: the log takes the sources' place, nobody watches.
    """
    chosen = [stack.entry(name) for name in only] or [
        entry
        for entry in stack.entries
        if entry.kind.reads and entry.kind.writes and not issubclass(entry.kind, Source | Tap)
    ]
    with ExitStack() as closing:
        services = {}
        for entry in chosen:
            services[entry.name] = service = entry.build()
            closing.callback(service.close)
            service.open()
            service.warm()
        yield Pipeline(services)


def live_stack(
    stack: Stack, log: Path, *, rate: float, loop: bool, start_s: float, end_s: float, out: Path | None
) -> str:
    """The stack file in which a player with the log stands in for the camera and the projector.

    What was recorded then is not recorded again, unless into ``out``.
    """
    tables: dict[str, Mapping[str, Any]] = {
        "rig": stack.rig.model_dump(exclude_none=True),
        "player": {},
    }
    played = {topics.FRAME, *CARRIED}
    for name, table in stack.tables.items():
        kind = stack.kind(name)
        if not played.intersection(kind.writes) and not issubclass(kind, Tap) and name not in (RELAY, ROUTER):
            tables[name] = {key: value for key, value in table.items() if key != "host"}  # all on this one
    if out is not None:
        tables["recorder"] = {"directory": str(out.resolve().parent), "name": out.stem}
    tables["player"] = {
        "log": str(log.resolve()),
        "rate": rate,
        "loop": loop,
        "start_s": start_s,
        "end_s": end_s,
        "after": [name for name in tables if name not in ("rig", "player")],
    }
    return stack_file.to_toml(tables)


class Digest:
    """One SHA-256 per topic over the encoded messages: equal replays have equal digests."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._sums: dict[str, Any] = {}

    def add(self, message: Message, encoded: bytes) -> None:
        name = topics.of(message).name
        self.counts[name] += 1
        self._sums.setdefault(name, hashlib.sha256()).update(encoded)

    def as_dict(self) -> dict[str, str]:
        return {name: total.hexdigest() for name, total in sorted(self._sums.items())}


def recording_of(path: Path, log: Log, stack: Stack) -> Recording:
    """A new log for the results, with the stack as replayed and the calibration of the old log."""
    attachments = [Attachment(STACK_FILE, "application/toml", stack.toml.encode())]
    if (calibration := log.attachments.get(CALIBRATION_FILE)) is not None:
        attachments.append(Attachment(CALIBRATION_FILE, "application/yaml", calibration))
    return Recording(path, {**host_facts(), "rig": stack.rig.name, "replayed_from": log.path.name}, attachments)


def replay(
    log: Log,
    pipeline: Pipeline,
    *,
    inputs: Collection[Topic] = (),
    start_ns: int = 0,
    end_ns: int = 1 << 63,
    into: Recording | None = None,
    digest: Digest | None = None,
) -> Iterator[Result]:
    """Feed a log's messages, in the order they arrived, and yield everything the services make of them.

    ``inputs``: only these topics of the log; else all that the services read and don't produce themselves.
    ``into`` gets the results and what is small of the inputs, at the inputs' times.
    """
    wanted = frozenset(inputs) or pipeline.inputs
    kept = {topic for topic in CARRIED if topic not in pipeline.written} if into is not None else set()
    for record in _read_ahead(log.records(wanted | kept, start_ns=start_ns, end_ns=end_ns)):
        topic = record.stream.topic
        if into is not None and topic in kept:
            into.put(entry_of(record.message(), record.payload, log_ns=record.log_ns))
        if topic not in wanted:
            continue
        for service, message in pipeline.feed(record.message()):
            if into is not None or digest is not None:
                _keep(Result(service, message, record), into, digest)
            yield Result(service, message, record)


def _read_ahead(records: Iterator[Record]) -> Iterator[Record]:
    """The same records; another thread meanwhile reads and checks the next ones."""
    with ThreadPoolExecutor(1, thread_name_prefix="read-ahead") as reader:
        coming = deque(reader.submit(next, records, None) for _ in range(AHEAD))
        while (record := coming.popleft().result()) is not None:
            coming.append(reader.submit(next, records, None))
            yield record


def _keep(result: Result, into: Recording | None, digest: Digest | None) -> None:
    message, cause = result.message, result.cause
    encoded = codec.encode(message)
    if digest is not None:
        digest.add(message, encoded)
    if into is not None:
        into.put(entry_of(message, encoded, source=result.service, log_ns=cause.log_ns))
