"""Where a log's bytes go."""

from __future__ import annotations

import fcntl
import os
from typing import Protocol

from endo3d.services.archive.layout import Buffer

DROP_BEHIND_BYTES = 32 << 20
"""Written pages go back to the kernel after this much: else it throttles the writer (360 for 2080 MB/s)."""


class Sink(Protocol):
    """Bytes in order, and one way back."""

    def write(self, *parts: Buffer) -> None:
        """All of them, in order. Raises ``OSError`` with part of them written."""

    def truncate(self, size: int) -> None:
        """Cut back to ``size`` bytes and go on from there."""

    def close(self) -> None:
        """Nothing more will come."""


class FileSink:
    """A file that keeps nothing in memory: ``writev`` in, drop-behind out."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
        # While this is open nobody repairs it; the kernel gives the lock back even after a kill -9.
        fcntl.flock(self._fd, fcntl.LOCK_EX)
        self._since_drop = 0

    def write(self, *parts: Buffer) -> None:
        left = sum(len(part) for part in parts)
        self._since_drop += left
        while (written := os.writev(self._fd, parts)) < left:
            left -= written
            parts = _after(parts, written)
        if self._since_drop >= DROP_BEHIND_BYTES:
            self._since_drop = 0
            os.posix_fadvise(self._fd, 0, 0, os.POSIX_FADV_DONTNEED)

    def truncate(self, size: int) -> None:
        os.ftruncate(self._fd, size)
        os.lseek(self._fd, size, os.SEEK_SET)

    def close(self) -> None:
        os.close(self._fd)


def _after(parts: tuple[Buffer, ...], written: int) -> tuple[Buffer, ...]:
    """What is left of ``parts`` when their first bytes are written."""
    rest = list(parts)
    while rest and written >= len(rest[0]):
        written -= len(rest.pop(0))
    return (memoryview(rest[0])[written:], *rest[1:]) if rest else ()
