"""Where a log's bytes go."""

from __future__ import annotations

import errno
import fcntl
import mmap
import os
from typing import Protocol

import numpy as np

from endo3d.services.archive.layout import Buffer

DROP_BEHIND_BYTES = 32 << 20
"""Written pages go back to the kernel after this much: else it throttles the writer (360 for 2080 MB/s)."""

BLOCK_BYTES = 4096
"""Unit of what goes past the kernel's cache: place in the file, size, address."""
STAGE_BYTES = 8 << 20
"""Most that goes to the disk at once."""


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


class DirectSink:
    """A file written past the kernel's cache, from a stage of whole blocks: half the work of a cached write.

    A block that is not full is written with zeros behind it, and again when it goes on: what ``write`` was given
    is in the file when it returns, and a kill leaves at most a block of zeros at its end.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Raises ``OSError``; EINVAL where the file system or the device can't."""
        self._fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC | os.O_DIRECT, 0o644)
        fcntl.flock(self._fd, fcntl.LOCK_EX)
        memory = mmap.mmap(-1, STAGE_BYTES)
        memory.madvise(mmap.MADV_HUGEPAGE)
        self._stage = np.frombuffer(memory, np.uint8)
        self._start = 0
        """Place of the stage in the file."""
        self._held = 0
        """Bytes on the stage."""
        try:
            os.pwrite(self._fd, self._stage[:BLOCK_BYTES].data, 0)
        except OSError:
            os.close(self._fd)
            raise

    def write(self, *parts: Buffer) -> None:
        for part in filter(len, parts):
            rest = np.frombuffer(part, np.uint8)
            while len(rest) > (room := STAGE_BYTES - self._held):
                self._take(rest[:room])
                self._put()
                rest = rest[room:]
            self._take(rest)
        self._put()

    def truncate(self, size: int) -> None:
        os.ftruncate(self._fd, size)
        self._start, self._held = size - size % BLOCK_BYTES, size % BLOCK_BYTES
        os.preadv(self._fd, [self._stage[:BLOCK_BYTES].data], self._start)

    def close(self) -> None:
        os.ftruncate(self._fd, self._start + self._held)
        os.close(self._fd)

    def _take(self, part: np.ndarray[tuple[int], np.dtype[np.uint8]]) -> None:
        self._stage[self._held : self._held + len(part)] = part
        self._held += len(part)

    def _put(self) -> None:
        """Write the stage; what does not fill a block stays on it."""
        end = -(-self._held // BLOCK_BYTES) * BLOCK_BYTES
        self._stage[self._held : end] = 0
        at = 0
        while at < end:
            written = os.pwrite(self._fd, self._stage[at:end].data, self._start + at) // BLOCK_BYTES * BLOCK_BYTES
            if not written:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            at += written
        full = self._held - self._held % BLOCK_BYTES
        self._start, self._held = self._start + full, self._held - full
        self._stage[: self._held] = self._stage[full : full + self._held]


def file_sink(path: str | os.PathLike[str]) -> Sink:
    """A file, past the kernel's cache where that works. Raises ``OSError``."""
    if hasattr(os, "O_DIRECT"):
        try:
            return DirectSink(path)
        except OSError as error:
            if error.errno != errno.EINVAL:
                raise
    return FileSink(path)


def _after(parts: tuple[Buffer, ...], written: int) -> tuple[Buffer, ...]:
    """What is left of ``parts`` when their first bytes are written."""
    rest = list(parts)
    while rest and written >= len(rest[0]):
        written -= len(rest.pop(0))
    return (memoryview(rest[0])[written:], *rest[1:]) if rest else ()
