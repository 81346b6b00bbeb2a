"""One message on its way into a log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from endo3d.schemas import codec, topics
from endo3d.schemas.messages import Message, ProjectorCalibration
from endo3d.services.archive.layout import Buffer
from endo3d.services.archive.writer import Kind

STACK_FILE = "stack.toml"
CALIBRATION_FILE = "calibration.yaml"
"""What every log carries along, by the attachment's name."""

COMPACT_IMAGE = Kind("endo3d.CompactImage", "endo3d.compact", b"")
"""Frames packed without loss: ``archive.compact``. Without a definition: only this program reads them."""


@dataclass(frozen=True, slots=True)
class Attachment:
    """A file kept in the log, byte for byte."""

    name: str
    media_type: str
    content: bytes


@dataclass(frozen=True, slots=True)
class Entry:
    """An encoded message and where it goes."""

    channel: str
    kind: Kind
    sequence: int
    log_ns: int
    """When it arrived at the recorder."""
    publish_ns: int
    """Its own stamp: the exposure."""
    payload: tuple[Buffer, ...]
    """The encoded message, in one or several parts."""
    metadata: Mapping[str, str] = field(default_factory=dict)
    """Of the channel; what the first entry of a channel says holds for all."""
    latched: bool = False
    """Every part of a split recording repeats the last one."""
    attachment: Attachment | None = None
    """A file that came with it: the calibration."""


def entry_of(
    message: Message, encoded: Buffer | None = None, *, source: str = "", log_ns: int | None = None
) -> Entry:
    """A message on its way into a log.

    encoded: its bytes, if they are there already. source: the service that wrote it, for topics written per
    service. log_ns: when it arrived; by default when it was made.
    """
    topic = topics.of(message)
    return Entry(
        channel=topic.channel(source),
        kind=Kind(*codec.schema(topic)),
        sequence=getattr(message, "sequence", 0),
        log_ns=message.stamp_ns if log_ns is None else log_ns,
        publish_ns=max(0, message.stamp_ns),  # the format knows no time before 1970
        payload=(codec.encode(message) if encoded is None else encoded,),
        latched=topic.latched,
        attachment=calibration_of(message),
    )


def calibration_of(message: Message) -> Attachment | None:
    """The calibration file, when a message carries it."""
    if not isinstance(message, ProjectorCalibration) or not message.yaml:
        return None
    return Attachment(CALIBRATION_FILE, "application/yaml", message.yaml.encode())
