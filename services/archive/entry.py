"""One message on its way into a log."""

from __future__ import annotations

from dataclasses import dataclass

from endo3d.services.archive.layout import Buffer
from endo3d.services.archive.writer import Kind

STACK_FILE = "stack.toml"
CALIBRATION_FILE = "calibration.yaml"
"""What every log carries along, by the attachment's name."""


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
    latched: bool = False
    """Every part of a split recording repeats the last one."""
    attachment: Attachment | None = None
    """A file that came with it: the calibration."""
