"""Log records of a process become log lines on the bus, and plain lines on stderr."""

from __future__ import annotations

import logging
import os
import sys
import threading
import time
from collections.abc import Callable
from typing import Final

from endo3d.schemas.messages import Level, LogLine

_PER_SECOND: Final = 20
"""More lines than this are counted instead of sent: a failing step must not flood the bus."""


def to_stderr(level: int = logging.INFO) -> None:
    """``LEVEL message``, one line per event; the launcher adds the service's name."""
    logging.basicConfig(stream=sys.stderr, level=level, format="%(levelname)s %(message)s", force=True)


class BusHandler(logging.Handler):
    """Sends records as ``LogLine``; at most 20 a second, the rest are counted in the next line."""

    def __init__(self, service: str, publish: Callable[[LogLine], None]) -> None:
        super().__init__(logging.INFO)
        self._service = service
        self._publish = publish
        self._second = 0
        self._sent = 0
        self._kept_back = 0
        self._sending = threading.local()

    def emit(self, record: logging.LogRecord) -> None:
        if getattr(self._sending, "now", False):  # a record about sending a record
            return
        second = int(time.monotonic())
        if second != self._second:
            self._second, self._sent = second, 0
        if self._sent >= _PER_SECOND:
            self._kept_back += 1
            return
        self._sent += 1
        text = record.getMessage()
        if self._kept_back:
            text += f" (and {self._kept_back} more lines before this one)"
            self._kept_back = 0
        self._sending.now = True
        try:
            self._publish(
                LogLine(
                    stamp_ns=int(record.created * 1e9),
                    level=_level(record.levelno),
                    message=text,
                    service=self._service,
                    file=os.path.basename(record.pathname),
                    line=record.lineno,
                )
            )
        except Exception:
            self.handleError(record)
        finally:
            self._sending.now = False


def _level(number: int) -> Level:
    if number >= logging.CRITICAL:
        return Level.FATAL
    if number >= logging.ERROR:
        return Level.ERROR
    if number >= logging.WARNING:
        return Level.WARNING
    return Level.INFO if number >= logging.INFO else Level.DEBUG
