"""Everything that travels, byte for byte, into MCAP files."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, ClassVar

from pydantic import Field

from endo3d.schemas import codec, topics
from endo3d.schemas.messages import Message, ProjectorCalibration
from endo3d.schemas.topics import Topic
from endo3d.services.archive.entry import CALIBRATION_FILE, STACK_FILE, Attachment, Entry
from endo3d.services.archive.facts import host_facts
from endo3d.services.archive.recording import Recording
from endo3d.services.archive.spool import Spool
from endo3d.services.archive.writer import Kind
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
    queue_mb: int = Field(default=256, ge=16)
    """What may wait for the disk; beyond it messages are dropped and counted."""
    floor_mb: int = Field(default=512, ge=0)
    """Recording stops, whole, when the disk has less than this left."""
    reserve_mb: int = Field(default=64, ge=0)
    """Disk space kept for the file's index in case somebody else fills the disk."""
    log_hz: dict[str, float] = Field(default_factory=dict)
    """Rates to archive, by topic, where they differ from the topics table; 0 is never."""
    rig: str = "rig"
    stack_toml: str = ""


class Recorder(Tap[RecorderConfig]):
    """Samples -> queue -> MCAP. Never blocks: what the disk can't take is dropped and counted."""

    Config = RecorderConfig
    reads = tuple(topic for topic in topics.TOPICS if topic.log_hz > 0)
    optional = reads
    commands: ClassVar[tuple[str, ...]] = ("start", "stop")

    def __init__(self, config: RecorderConfig) -> None:
        super().__init__(config)
        unknown = config.log_hz.keys() - topics.BY_NAME.keys()
        if unknown:
            known = ", ".join(topics.BY_NAME)
            raise ValueError(f"log_hz: no topic {', '.join(sorted(unknown))}; known are {known}")
        self._kinds = {topic.name: Kind(*codec.schema(topic)) for topic in self.reads}
        self._period_ns = {
            topic.name: _period_ns(config.log_hz.get(topic.name, topic.log_hz)) for topic in self.reads
        }
        self._due_ns: dict[str, int] = {}
        self._latched: dict[str, Entry] = {}
        self._lost: Counter[str] = Counter()
        self._spool: Spool | None = None
        self._start_at_next = config.autostart

    def take(self, sample: Sample) -> Iterator[Message]:
        try:
            entry = self._entry(sample)
        except codec.Malformed:
            self._lost[f"{sample.topic.name}:malformed"] += 1
            return
        if self._start_at_next:
            self._start(self.config.name, sample.received_ns)
        if self._spool is not None and self._due(entry, sample.topic):
            self._spool.put(entry, sample.valid)
        if entry.latched:
            self._latched[entry.channel] = replace(entry, payload=(bytes(sample.payload),))
        yield from ()

    def command(
        self, verb: str, parameters: Mapping[str, Any], now_ns: int
    ) -> Iterator[Message | Mapping[str, Any]]:
        match verb:
            case "start":
                if self._spool is not None and not self._spool.trouble:
                    raise Refused(f"already recording {self._spool.recording.path}; stop it first")
                self._stop()
                spool = self._start(str(parameters.get("name", "")), now_ns)
                yield {"recording": str(spool.recording.path)}
            case "stop":
                if self._spool is None:
                    raise Refused("not recording; start it first")
                recording, dropped = self._spool.recording, self._spool.dropped
                self._stop()
                yield {
                    "files": [str(part) for part in recording.parts],
                    "messages": recording.messages,
                    "dropped": dropped.total(),
                    "bytes": recording.size,
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
        return self._lost + Counter(_causes(self._spool))

    def trouble(self) -> str:
        return self._spool.trouble if self._spool is not None else ""

    def close(self) -> None:
        self._stop()

    def _entry(self, sample: Sample) -> Entry:
        """Where a sample goes in the log. Raises ``codec.Malformed``."""
        message = codec.decode(sample.topic, sample.payload)
        attachment = None
        if isinstance(message, ProjectorCalibration) and message.yaml:
            attachment = Attachment(CALIBRATION_FILE, "application/yaml", message.yaml.encode())
        return Entry(
            channel=sample.topic.channel(sample.source),
            kind=self._kinds[sample.topic.name],
            sequence=getattr(message, "sequence", 0),
            log_ns=sample.received_ns,
            publish_ns=message.stamp_ns,
            payload=(sample.payload,),
            latched=sample.topic.latched,
            attachment=attachment,
        )

    def _due(self, entry: Entry, topic: Topic) -> bool:
        """Whether the topic's archive rate has room for this message."""
        period_ns = self._period_ns[topic.name]
        due_ns = self._due_ns.get(entry.channel, 0)
        if period_ns is None or entry.log_ns < due_ns:
            return False
        self._due_ns[entry.channel] = max(due_ns, entry.log_ns - period_ns) + period_ns
        return True

    def _start(self, name: str, now_ns: int) -> Spool:
        self._start_at_next = False
        config = self.config
        started = datetime.fromtimestamp(now_ns * 1e-9, UTC)
        name = name or f"{config.rig}-{started:%Y%m%dT%H%M%SZ}"
        recording = Recording(
            config.directory / f"{name}.mcap",
            {**host_facts(), "rig": config.rig, "started": started.isoformat()},
            [Attachment(STACK_FILE, "application/toml", config.stack_toml.encode())],
            split_bytes=config.split_mb << 20,
            split_s=config.split_s,
        )
        self._spool = Spool(
            recording,
            queue_bytes=config.queue_mb << 20,
            floor_bytes=config.floor_mb << 20,
            reserve_bytes=config.reserve_mb << 20,
        )
        for entry in self._latched.values():
            self._spool.put(replace(entry, log_ns=now_ns))
        _log.info("recording %s", recording.path)
        return self._spool

    def _stop(self) -> None:
        if (spool := self._spool) is not None:
            self._spool = None
            spool.close()
            self._lost.update(_causes(spool))
            _log.info("recorded %s: %d messages", spool.recording.path, spool.recording.messages)


def _period_ns(rate_hz: float) -> int | None:
    """Time between archived messages; None is never."""
    return round(1e9 / rate_hz) if rate_hz > 0 else None


def _causes(spool: Spool) -> Mapping[str, int]:
    return {f"{channel.removeprefix('/')}:disk": count for channel, count in spool.dropped.items()}
