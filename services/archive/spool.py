"""Between the pipeline and the disk: a bounded queue, the thread that writes, and counted drops."""

from __future__ import annotations

import logging
import os
import tempfile
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import IO

from endo3d.services.archive.entry import Entry
from endo3d.services.archive.recording import Recording
from endo3d.services.archive.writer import OWN_CHUNK_BYTES

FLUSH_S = 0.5
"""Small messages wait at most this long in memory."""
QUEUE_MESSAGES = 1 << 16
"""So many messages are queued at most, however small."""
SLOT_BYTES = 1 << 16
"""Slots come in multiples of this."""

_log = logging.getLogger(__name__)


class Slots:
    """Reused memory: page faults of a fresh image-sized allocation cost more than the copy."""

    def __init__(self, budget_bytes: int) -> None:
        self._budget = budget_bytes
        self._allocated = 0
        self._free: defaultdict[int, list[bytearray]] = defaultdict(list)
        self._lock = threading.Lock()

    def take(self, size: int) -> bytearray | None:
        """Memory of at least ``size`` bytes; None when the budget is spent."""
        capacity = -(-size // SLOT_BYTES) * SLOT_BYTES
        with self._lock:
            if free := self._free[capacity]:
                return free.pop()
            if self._allocated + capacity > self._budget:
                for other, slots in self._free.items():
                    self._allocated -= other * len(slots)
                    slots.clear()
            if self._allocated + capacity > self._budget:
                return None
            self._allocated += capacity
        return bytearray(capacity)

    def give(self, slot: bytearray) -> None:
        """Back for the next message."""
        with self._lock:
            self._free[len(slot)].append(slot)


class Spool:
    """Takes entries without ever blocking and writes them in a thread of its own.

    ``transform`` runs in that thread (packing). When the disk has less than ``floor_bytes`` left, or a write
    fails, the recording is closed whole and everything after it counts as dropped; ``trouble`` says why.
    """

    def __init__(
        self,
        recording: Recording,
        *,
        queue_bytes: int,
        floor_bytes: int = 0,
        reserve_bytes: int = 0,
        transform: Callable[[Entry], Entry] = lambda entry: entry,
    ) -> None:
        self.recording = recording
        self._refused: Counter[str] = Counter()
        self._unwritten: Counter[str] = Counter()
        # Two counters, for two threads count: the caller's and the writer's.
        self.trouble = ""
        """One line for people once recording has stopped by itself."""
        self._slots = Slots(queue_bytes)
        self._queue: SimpleQueue[tuple[Entry, bytearray] | None] = SimpleQueue()
        self._floor_bytes = floor_bytes
        self._transform = transform
        self._reserve = _reserve(recording.path.parent, reserve_bytes)
        self._thread = threading.Thread(target=self._run, name="archive", daemon=True)
        self._thread.start()

    @property
    def dropped(self) -> Counter[str]:
        """Messages lost, per channel."""
        return self._refused.copy() + self._unwritten.copy()

    @property
    def queued(self) -> int:
        """Messages waiting to be written."""
        return self._queue.qsize()

    def put(
        self,
        entry: Entry,
        size: int,
        fill: Callable[[memoryview], object],
        valid: Callable[[], bool] = lambda: True,
    ) -> bool:
        """Queue an entry whose payload of ``size`` bytes ``fill`` writes. False, and counted, without room.

        ``valid`` is asked after the filling: False when its source was overwritten meanwhile.
        """
        memory, kept = self._memory(size), False
        if memory is not None:
            payload = memoryview(memory)[:size]
            try:
                fill(payload)
                kept = valid()
            finally:
                if not kept:
                    self._give(memory)
        if memory is None or not kept:
            self._refused[entry.channel] += 1
            return False
        self._queue.put((replace(entry, payload=(payload,)), memory))
        return True

    def close(self) -> None:
        """Write what is queued and close the file; blocks until that is done."""
        self._queue.put(None)
        self._thread.join()

    def _memory(self, size: int) -> bytearray | None:
        """Where a payload of ``size`` bytes waits; None when there is no room."""
        if self.trouble or self._queue.qsize() >= QUEUE_MESSAGES:
            return None
        return bytearray(size) if size < OWN_CHUNK_BYTES else self._slots.take(size)

    def _give(self, memory: bytearray) -> None:
        if len(memory) >= OWN_CHUNK_BYTES:
            self._slots.give(memory)

    def _run(self) -> None:
        flush_due = time.monotonic() + FLUSH_S
        while True:
            try:
                item = self._queue.get(timeout=max(0.0, flush_due - time.monotonic()))
            except Empty:
                self._guarded(self.recording.flush)
                flush_due = time.monotonic() + FLUSH_S
                continue
            if item is None:
                break
            entry, memory = item
            if not self._guarded(self._write, entry):
                self._unwritten[entry.channel] += 1
            self._give(memory)
            self._guarded(self._look_at_disk)
            if time.monotonic() >= flush_due:
                self._guarded(self.recording.flush)
                flush_due = time.monotonic() + FLUSH_S
        self._guarded(self.recording.finish)
        self._reserve.close()

    def _write(self, entry: Entry) -> None:
        if self.trouble:
            self._unwritten[entry.channel] += 1
        else:
            self.recording.put(self._transform(entry))

    def _look_at_disk(self) -> None:
        free_bytes = _free_bytes(self.recording.path.parent)
        if free_bytes < self._floor_bytes and not self.trouble:
            self._stop(f"only {free_bytes >> 20} MB left on the disk: log closed; make room, start again")
            self.recording.finish()

    def _guarded(self, write: Callable[..., None], *arguments: Entry) -> bool:
        """A failed write ends the recording, not the thread: the queue is emptied and drops are counted."""
        try:
            write(*arguments)
            return True
        except Exception as error:  # whatever it is, the pipeline goes on and the status says it
            self._reserve.close()
            what = error.strerror if isinstance(error, OSError) else f"{type(error).__name__}: {error}"
            self._stop(f"{what}: recording closed; make room on the disk and start again")
            try:
                self._unwritten.update(self.recording.abandon_tail())
                self.recording.finish()
            except OSError as second:
                self.recording.leave_torn()
                self._stop(f"{second.strerror}: no index; endo3d recover {self.recording.parts[-1]}")
            return False

    def _stop(self, why: str) -> None:
        self.trouble = why
        _log.error("%s", why)


def _reserve(directory: Path, size: int) -> IO[bytes]:
    """A nameless file of ``size`` bytes: closed, or its process killed, it gives room for a log's end."""
    directory.mkdir(parents=True, exist_ok=True)
    file = tempfile.TemporaryFile(dir=directory)  # noqa: SIM115 - as long as the recording lasts
    if size:
        try:
            os.posix_fallocate(file.fileno(), 0, size)
        except OSError as error:
            _log.warning("no reserve of %d MB for the log's end: %s", size >> 20, error.strerror)
    return file


def _free_bytes(directory: Path) -> int:
    state = os.statvfs(directory)
    return state.f_bavail * state.f_frsize
