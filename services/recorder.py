"""Everything that travels, byte for byte, into MCAP files."""

from __future__ import annotations

import logging
import math
import os
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from pydantic import Field, field_validator

from endo3d.schemas import codec, topics
from endo3d.schemas.messages import Frame, Message
from endo3d.schemas.topics import Topic
from endo3d.services.archive.crop import Crop
from endo3d.services.archive.entry import COMPACT_IMAGE, STACK_FILE, Attachment, Entry, entry_of
from endo3d.services.archive.facts import host_facts
from endo3d.services.archive.layout import Buffer
from endo3d.services.archive.reader import Unreadable
from endo3d.services.archive.recording import Recording
from endo3d.services.archive.recover import is_whole, recover
from endo3d.services.archive.spool import Spool
from endo3d.services.runtime.errors import UserError
from endo3d.services.runtime.service import Config, Refused, Sample, Tap

_log = logging.getLogger(__name__)


class RecorderConfig(Config):
    """Where and how to record."""

    directory: Path = Path("logs")
    name: str = ""
    """File name without suffix; empty: rig and time of the first message."""
    autostart: bool = True
    """Record from the first message on, without being asked."""
    split_mb: int = Field(default=0, ge=0)
    """A new file after so many MB; 0 is never."""
    split_s: float = Field(default=0.0, ge=0)
    """A new file after so many seconds; 0 is never."""
    queue_mb: int = Field(default=512, ge=16)
    """What may wait for the disk; beyond it messages are dropped and counted."""
    floor_mb: int = Field(default=512, ge=0)
    """Recording stops, whole, when the disk has less than this left."""
    reserve_mb: int = Field(default=64, ge=0)
    """Disk space kept for the file's index in case somebody else fills the disk."""
    compact: bool = False
    """Pack frames without loss, about 2:1; only endo3d reads them then."""
    crop: bool = False
    """Keep of each frame only the square around the fibre's image circle; the rest is dark."""
    log_hz: dict[str, float] = Field(default_factory=dict)
    """Rates to archive, by topic, where they differ from the topics table; 0 is never."""
    rig: str = "rig"
    head: str = ""
    stack_toml: str = ""

    @field_validator("log_hz")
    @classmethod
    def _of_topics(cls, rates: dict[str, float]) -> dict[str, float]:
        if unknown := rates.keys() - topics.BY_NAME.keys():
            raise ValueError(f"no topic {', '.join(sorted(unknown))}; known are {', '.join(topics.BY_NAME)}")
        return rates


class Recorder(Tap[RecorderConfig]):
    """Samples -> queue -> MCAP. Never blocks: what the disk can't take is dropped and counted."""

    Config = RecorderConfig
    reads = tuple(topic for topic in topics.TOPICS if topic.log_hz > 0)
    optional = reads
    commands: ClassVar[tuple[str, ...]] = ("start", "stop")

    def __init__(self, config: RecorderConfig) -> None:
        super().__init__(config)
        self._log_hz = {topic: config.log_hz.get(topic.name, topic.log_hz) for topic in self.reads}
        self._due_ns: dict[str, int] = {}
        self._latched: dict[str, Entry] = {}
        self._lost: Counter[str] = Counter()
        self._transform: Callable[[Entry], Entry] = _as_it_is
        self._facts: Mapping[str, str] = {}
        self._circle_share = 0.0
        """Diameter of the image circle in widths of the image."""
        self._trouble = ""
        self._crop: Crop | None = None
        self._spool: Spool | None = None
        self._repairing: threading.Thread | None = None
        self._start_at_next = config.autostart

    def newest_hz(self, topic: Topic) -> float | None:
        """Of a large topic that is thinned out, what is not archived is not even looked at."""
        hz = self._log_hz[topic]
        return hz if hz == 0 or (topic.bulk and math.isfinite(hz)) else None

    def open(self) -> None:
        """Repair what a crash left torn in the directory, in the background.

        Raises ``UserError`` when it can't be written to, a package for packing is missing, or the head's file
        for cropping.
        """
        self._facts = host_facts()
        self._transform = _compactor() if self.config.compact else _as_it_is
        if self.config.crop:
            self._circle_share = _circle_share(self.config.head)
        directory = self.config.directory
        try:
            directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"can't make the directory {directory}: {error.strerror}; choose another") from error
        if not os.access(directory, os.W_OK | os.X_OK):
            raise UserError(f"can't write into {directory}; set recorder.directory to another")
        logs = sorted(directory.glob("*.mcap"))  # now: the one to be recorded is none of them
        self._repairing = threading.Thread(target=_repair, args=(logs,), name="repair", daemon=True)
        self._repairing.start()

    def take(self, sample: Sample) -> Iterator[Message]:
        try:
            message = codec.decode(sample.topic, sample.payload)
        except codec.Malformed:
            self._lost[f"{sample.topic.name}:malformed"] += 1
            return
        entry = entry_of(message, sample.payload, source=sample.source, log_ns=sample.received_ns)
        if self._start_at_next:
            self._autostart(sample.received_ns)
        if self._spool is not None and self._due(entry, sample.topic):
            self._put(self._spool, entry, sample, message)
        if entry.latched:
            self._latched[entry.channel] = replace(entry, payload=(bytes(sample.payload),))
        yield from ()

    def _autostart(self, now_ns: int) -> None:
        self._start_at_next = False
        try:
            self._start(self.config.name, now_ns)
        except OSError as error:
            self._trouble = f"can't record into {self.config.directory}: {error.strerror}; endo3d record start"
            _log.error("%s", self._trouble)

    def command(self, verb: str, parameters: Mapping[str, Any], now_ns: int) -> Iterator[Message | Mapping[str, Any]]:
        match verb:
            case "start":
                if self._spool is not None and not self._spool.trouble:
                    raise Refused(f"already recording {self._spool.recording.path}; stop it first")
                name = str(parameters.get("name", ""))
                if name != Path(name).name:
                    raise Refused(f"{name!r} is not a plain file name")
                self._stop()
                try:
                    spool = self._start(name, now_ns)
                except OSError as error:
                    raise Refused(f"can't record into {self.config.directory}: {error.strerror}") from error
                yield {"recording": str(spool.recording.path)}
            case "stop":
                if self._spool is None:
                    raise Refused("not recording; start it first")
                spool = self._spool
                self._stop()
                yield {
                    "files": [str(part) for part in spool.recording.parts],
                    "messages": spool.recording.messages,
                    "dropped": spool.dropped.total(),
                    "bytes": spool.recording.size,
                }
            case _:
                yield from super().command(verb, parameters, now_ns)

    def values(self) -> Mapping[str, float]:
        if self._spool is None:
            return {"recording": 0.0}
        recording = self._spool.recording
        return {
            "recording": 0.0 if self._spool.trouble else 1.0,
            "mb": recording.size / 1e6,
            "messages": recording.messages,
            "queued": self._spool.queued,
        }

    def losses(self) -> Mapping[str, int]:
        if self._spool is None:
            return dict(self._lost)
        return self._lost.copy() + Counter(_causes(self._spool))

    def trouble(self) -> str:
        return self._spool.trouble if self._spool is not None else self._trouble

    def close(self) -> None:
        self._stop()
        if self._repairing is not None:
            self._repairing.join()

    def _put(self, spool: Spool, entry: Entry, sample: Sample, message: Message) -> None:
        """Queue a sample: the received bytes, or those of the image circle alone."""
        if isinstance(message, Frame):
            if self.config.crop and self._crop is None:
                rows, columns = message.image.shape
                self._crop = Crop.around_circle(self._circle_share * columns, rows, columns)
            if self._crop is not None:
                if message.image.shape != (self._crop.of_rows, self._crop.of_columns):
                    self._lost["frame:other size than the recording's first"] += 1
                    return
                message = self._crop.cut(message)
                entry = replace(entry, metadata=self._crop.metadata())
            foreign = self.config.compact and codec.data_span(sample.payload)[1] != len(sample.payload)
            if self._crop is not None or foreign:
                size = codec.encoded_size(message)
                spool.put(entry, size, partial(codec.encode_into, message), sample.valid)
                return
        spool.put(entry, len(sample.payload), partial(_copy, sample.payload), sample.valid)

    def _due(self, entry: Entry, topic: Topic) -> bool:
        """Whether the topic's archive rate has room for this message."""
        hz = self._log_hz[topic]
        if hz == 0:
            return False
        period_ns = round(1e9 / hz)
        due_ns = self._due_ns.get(entry.channel, entry.log_ns)
        if entry.log_ns < due_ns:
            return False
        # In step with the rate while messages come, so that jitter costs none; from now on after a pause.
        late = entry.log_ns >= due_ns + period_ns
        self._due_ns[entry.channel] = (entry.log_ns if late else due_ns) + period_ns
        return True

    def _start(self, name: str, now_ns: int) -> Spool:
        self._start_at_next, self._trouble = False, ""
        config = self.config
        started = datetime.fromtimestamp(now_ns * 1e-9, UTC)
        name = name or f"{config.rig}-{started:%Y%m%dT%H%M%SZ}"
        recording = Recording(
            config.directory / f"{name}.mcap",
            {**self._facts, "rig": config.rig, "started": started.isoformat()},
            [Attachment(STACK_FILE, "application/toml", config.stack_toml.encode())],
            split_bytes=config.split_mb << 20,
            split_s=config.split_s,
        )
        self._spool = Spool(
            recording,
            queue_bytes=config.queue_mb << 20,
            floor_bytes=config.floor_mb << 20,
            reserve_bytes=config.reserve_mb << 20,
            transform=self._transform,
        )
        self._due_ns.clear()
        self._crop = None
        for entry in self._latched.values():
            (payload,) = entry.payload
            self._spool.put(replace(entry, log_ns=now_ns), len(payload), partial(_copy, payload))
        _log.info("recording %s", recording.path)
        return self._spool

    def _stop(self) -> None:
        if (spool := self._spool) is not None:
            self._spool = None
            spool.close()
            self._lost.update(_causes(spool))
            _log.info("recorded %s: %d messages", spool.recording.path, spool.recording.messages)


def _copy(payload: Buffer, memory: memoryview) -> None:
    memory[:] = payload


def _as_it_is(entry: Entry) -> Entry:
    return entry


def _circle_share(head: str) -> float:
    """Diameter of the camera fibre's image in widths of the image, as the head's file says."""
    from endo3d_core.calibration import Rig  # its kernels take a second to load
    from endo3d_core.head import Head

    try:
        text = Path(head).read_text(encoding="utf-8")
        return Head.from_yaml(text).camera_circle_px / Rig.from_yaml(text).camera.width
    except (OSError, ValueError) as error:
        raise UserError(f"crop needs the head's file, and {head or 'none'} is no such: {error}") from error


def _compactor() -> Callable[[Entry], Entry]:
    """Packs frames and leaves the rest alone."""
    from endo3d.services.archive.compact import Packer  # its kernels take a second to load

    pack = Packer()
    channel = topics.FRAME.channel()

    def packed(entry: Entry) -> Entry:
        if entry.channel != channel:
            return entry
        return replace(entry, kind=COMPACT_IMAGE, payload=pack(memoryview(entry.payload[0])))

    return packed


def _repair(logs: Sequence[Path]) -> None:
    """Give every torn log its index; one that is being recorded, or beyond repair, stays as it is."""
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 19)  # the recording comes first
    for path in logs:
        try:
            if not is_whole(path):
                report = recover(path)
                _log.warning("repaired %s: %d messages kept", path, report.messages)
        except (Unreadable, OSError) as error:
            _log.warning("%s", error)


def _causes(spool: Spool) -> Mapping[str, int]:
    return {f"{channel.removeprefix('/')}:disk": count for channel, count in spool.dropped.items()}
