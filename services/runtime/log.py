"""Log records of a process become log lines on the bus, and lines on stderr: for people, or JSON for programs."""

from __future__ import annotations

import json
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


FORMAT_VARIABLE: Final = "ENDO3D_LOG"
"""Environment variable: ``json`` for one JSON object per event, tracebacks inside it."""


def to_stderr(level: int = logging.INFO) -> None:
    """``LEVEL message``, or JSON; the launcher adds the service's name."""
    handler = logging.StreamHandler(sys.stderr)
    as_json = os.environ.get(FORMAT_VARIABLE) == "json"
    handler.setFormatter(JsonFormatter() if as_json else logging.Formatter("%(levelname)s %(message)s"))
    logging.basicConfig(level=level, handlers=[handler], force=True)


class JsonFormatter(logging.Formatter):
    """An event as a JSON object on one line, its time in UTC."""

    converter = staticmethod(time.gmtime)

    def format(self, record: logging.LogRecord) -> str:
        event: dict[str, object] = {
            "time": f"{self.formatTime(record, '%Y-%m-%dT%H:%M:%S')}.{int(record.msecs):03}Z",
            "level": str(_level(record.levelno)),
            "message": record.getMessage(),
            "file": os.path.basename(record.pathname),
            "line": record.lineno,
        }
        if record.exc_info:
            event["exception"] = self.formatException(record.exc_info)
        return json.dumps(event)


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
