"""A log acts as the camera: its frames, and what belongs to them, at the recorded pace or any other."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from pydantic import Field, field_validator

from endo3d.schemas import topics
from endo3d.schemas.messages import Frame, Message, Mode, ServiceState, Status, Truth
from endo3d.services.archive.reader import Log, Record
from endo3d.services.runtime.errors import UserError
from endo3d.services.runtime.service import Config, Refused, Source

_NEVER_NS = 1 << 63
EPOCHS_PER_PASS = 1 << 16

PLAYED = (topics.CAMERA, topics.PROJECTOR, topics.MODE, topics.FRAME, topics.TRUTH)
"""What a camera and its projector write."""


class PlayerConfig(Config):
    """Which log, and how fast."""

    log: Path
    rate: float = Field(default=1.0, ge=0)
    """Times the recorded pace; ``inf`` is as fast as it can be read, 0 pauses."""
    loop: bool = False
    """Start over at the end; otherwise the player is finished there."""
    start_s: float = Field(default=0.0, ge=0)
    end_s: float = Field(default=math.inf, gt=0)
    """What part of the log, in seconds from its start."""
    topics: tuple[str, ...] = tuple(topic.name for topic in PLAYED)
    """What of the log is played."""
    after: tuple[str, ...] = ()
    """Services that have to be ready before anything is played: a camera would run on, a log would be lost."""
    restamp: bool = True
    """Stamps become the time of playing, so that latencies count from now; else they stay as recorded."""

    @field_validator("topics")
    @classmethod
    def _playable(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        known = [topic.name for topic in PLAYED]
        if unknown := set(names) - set(known):
            raise ValueError(f"can't play {', '.join(sorted(unknown))}; a camera writes {', '.join(known)}")
        return names


class Player(Source[PlayerConfig]):
    """Recorded messages again. Each pass through the log and each seek begins a new epoch."""

    Config = PlayerConfig
    reads = (topics.STATUS,)
    optional = reads
    writes = PLAYED
    commands: ClassVar[tuple[str, ...]] = ("seek", "rate")

    now_ns: Callable[[], int] = staticmethod(time.time_ns)
    wait: Callable[[float], None] = staticmethod(time.sleep)
    """A camera has its own clock, and so has this one; tests bring theirs."""

    def __init__(self, config: PlayerConfig) -> None:
        super().__init__(config)
        self._topics = [topic for topic in PLAYED if topic.name in config.topics]
        self._rate = config.rate
        self._awaited = set(config.after)
        self._records: Iterator[Record] = iter(())
        self._waiting: Record | None = None
        self._position_s = 0.0
        self._anchor: tuple[int, int] | None = None
        """A recorded stamp and the time it was played at."""
        self._played = False
        self._frame_due_ns: int | None = None
        self._next_frame_ns = 0
        """When the frame after the last is due, if it comes a period later: a loop has no gap and no rush."""
        self._passes = -1
        self._next_sequence = 0
        self._sequence_shift: int | None = None

    def open(self) -> None:
        """Raises ``UserError``: a missing, torn or foreign file, a start behind its end."""
        self._log = Log(self.config.log)
        try:
            self._seek(self.config.start_s)
        except Refused as refused:
            raise UserError(f"start_s = {self.config.start_s}: {refused}") from refused

    def step(self, message: Message) -> Iterator[Message]:
        if isinstance(message, Status) and message.state in (ServiceState.READY, ServiceState.RUNNING):
            self._awaited.discard(message.service)
        yield from ()

    def poll(self, timeout_s: float) -> Iterator[Message]:
        if self._awaited:
            self.wait(timeout_s)
            return
        if self._waiting is None:
            self._waiting = next(self._records, None)
        if self._waiting is None:
            self._at_end()
            return
        now_ns = self.now_ns()
        due_ns = self._due_ns(self._waiting, now_ns)
        if due_ns > now_ns + round(timeout_s * 1e9):
            self.wait(timeout_s)
            return
        if due_ns > now_ns:
            self.wait((due_ns - now_ns) * 1e-9)
        record, self._waiting = self._waiting, None
        yield self._again(record, due_ns)

    def command(self, verb: str, parameters: Mapping[str, Any], now_ns: int) -> Iterator[Message | Mapping[str, Any]]:
        match verb:
            case "seek":
                self._seek(_number(parameters, "s"))
            case "rate":
                self._rate, self._anchor = _number(parameters, "rate"), None
            case _:
                yield from super().command(verb, parameters, now_ns)
                return
        yield {"position_s": self._position_s, "duration_s": self._log.duration_s, "rate": self._rate}

    def values(self) -> Mapping[str, float]:
        return {"position_s": self._position_s, "duration_s": self._log.duration_s, "rate": self._rate}

    def _seek(self, position_s: float) -> None:
        """Go on from ``position_s`` seconds into the log, in a new epoch."""
        log = self._log
        if not 0 <= position_s <= log.duration_s:
            raise Refused(f"the log is {log.duration_s:.1f} s long; seek within it")
        end_ns = log.end_ns + 1
        if math.isfinite(self.config.end_s):
            end_ns = log.start_ns + round(self.config.end_s * 1e9)
        start_ns = log.start_ns + round(position_s * 1e9)
        self._records = log.records(self._topics, start_ns=start_ns, end_ns=end_ns, check=False)
        self._waiting = None
        self._position_s = position_s
        self._anchor = None
        self._played = False
        self._frame_due_ns = None
        self._next_frame_ns = 0
        self._passes += 1
        self._sequence_shift = None

    def _at_end(self) -> None:
        if self.config.loop and self._played:
            next_ns = self._next_frame_ns
            self._seek(self.config.start_s)
            self._next_frame_ns = next_ns
        else:
            self.finished = True

    def _due_ns(self, record: Record, now_ns: int) -> int:
        """When a record's time has come: its stamp on the clock that the first frame started."""
        if self._rate == 0:
            return _NEVER_NS
        if record.stream.topic is topics.FRAME and (self._anchor is None or math.isinf(self._rate)):
            self._anchor = (record.publish_ns, max(now_ns, self._next_frame_ns))
        if self._anchor is None:
            return now_ns
        recorded_ns, played_ns = self._anchor
        return played_ns + round((record.publish_ns - recorded_ns) / self._rate)

    def _again(self, record: Record, due_ns: int) -> Message:
        """The recorded message as a camera would give it now."""
        message = record.message()
        self._played = True
        self._position_s = (record.log_ns - self._log.start_ns) * 1e-9
        if self.config.restamp:
            message = replace(message, stamp_ns=due_ns)
        later_ns = message.stamp_ns - record.publish_ns
        match message:
            case Mode():
                return replace(message, epoch=self._epoch(message.epoch), start_ns=message.start_ns + later_ns)
            case Truth():
                return replace(message, sequence=self._sequence(message.sequence))
            case Frame():
                self._next_frame_ns = due_ns + (due_ns - (self._frame_due_ns or due_ns))
                self._frame_due_ns = due_ns
                image = self.loan(topics.FRAME, message.image.shape, message.image.dtype)
                np.copyto(image, message.image)
                return replace(
                    message,
                    image=image,
                    sequence=self._sequence(message.sequence),
                    epoch=self._epoch(message.epoch),
                    trigger_ns=message.trigger_ns + later_ns,
                )
        return message

    def _sequence(self, recorded: int) -> int:
        """Goes on counting where the last pass ended."""
        if self._sequence_shift is None:
            self._sequence_shift = self._next_sequence - recorded if self._passes else 0
        played = recorded + self._sequence_shift
        self._next_sequence = max(self._next_sequence, played + 1)
        return played

    def _epoch(self, recorded: int) -> int:
        """Of a range of its own per pass, so that frames of two passes never decode together."""
        return recorded + self._passes * EPOCHS_PER_PASS


def _number(parameters: Mapping[str, Any], name: str) -> float:
    try:
        value = float(parameters[name])
    except (KeyError, TypeError, ValueError):
        raise Refused(f"needs a number {name!r}, e.g. {name}=2.0") from None
    if not value >= 0:
        raise Refused(f"{name} must not be negative")
    return value
