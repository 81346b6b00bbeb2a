"""The writer's shared memory: a pool of equal chunks, loaned as arrays and sealed in place."""

from __future__ import annotations

import contextlib
import os
from typing import Final

from zenoh import ZBytes, ZError
from zenoh.shm import AllocAlignment, GarbageCollect, JustAlloc, ShmProvider, ZShmMut

from endo3d.services.runtime.errors import UserError
from endo3d.services.runtime.service import Exhausted
from endo3d.services.runtime.shm_view import Chunk, View, copy_of, find_view, probe_content

SLOTS: Final = 40
"""Chunks per pool: the queues of three readers, the windows they work on, and some air."""
_CACHE_LINE: Final = AllocAlignment(6)
_POLICY: Final = GarbageCollect(GarbageCollect(), JustAlloc(), safe=False)
"""Unsafe collection also takes back what a killed reader held; that is why readers ask ``is_valid`` after
their work. Safe collection leaks those chunks, and the blocking policy stalls the writer."""
_SHM: Final = "/dev/shm"


class Pool:
    """Shared memory for messages of up to ``chunk_bytes``."""

    def __init__(self, chunk_bytes: int, view: View | None, slots: int = SLOTS) -> None:
        """``view`` None: chunks are ordinary memory, copied when sealed.

        Raises ``UserError`` when /dev/shm is too small.
        """
        self.chunk_bytes = _whole_lines(chunk_bytes)
        self.total_bytes = self.chunk_bytes * (slots + 1)
        _require_space(self.total_bytes)
        self._view = view
        self._provider = ShmProvider.default_backend((self.total_bytes, _CACHE_LINE))

    def take(self, size: int) -> Chunk:
        """A fresh chunk of ``size`` bytes, to be written and sealed; raises ``Exhausted``."""
        try:
            owner = self._provider.alloc(size, _POLICY)
        except ZError as error:
            raise Exhausted(str(error)) from None
        return copy_of(owner, size) if self._view is None else self._view(owner, size)

    def free(self) -> int:
        """How many chunks could be had now: all but those that somebody writes or looks at."""
        chunks: list[Chunk] = []
        with contextlib.suppress(Exhausted):
            while True:
                chunks.append(self.take(self.chunk_bytes))
        return len(chunks)


def is_loan(chunk: Chunk) -> bool:
    """A chunk that is not sealed yet."""
    return isinstance(chunk.owner, ZShmMut)


def seal(chunk: Chunk) -> ZBytes:
    """The payload to put. Arrays over the chunk stay readable and must not be written any more."""
    assert isinstance(chunk.owner, ZShmMut)
    if chunk.backing is not None:
        chunk.owner[0 : chunk.size] = chunk.backing.tobytes()
    payload = ZBytes(chunk.owner)
    chunk.owner = payload.as_shm() if chunk.backing is None else None
    return payload


def self_test() -> View | None:
    """Find the zero-copy view and prove it on a real chunk: write, seal, read. None: use the copying API.

    Raises ``ZError`` when there is no shared memory at all.
    """
    content = probe_content()
    provider = ShmProvider.default_backend((_whole_lines(4 * len(content)), _CACHE_LINE))
    owner = provider.alloc(len(content), _POLICY)
    owner[0 : len(content)] = content
    view = find_view(owner, content)
    if view is None:
        return None
    chunk = view(owner, len(content))
    chunk.array()[:] = chunk.array()[::-1].copy()
    sealed = seal(chunk).as_shm()
    proven = sealed is not None and view(sealed, len(content)).array().tobytes() == content[::-1]
    return view if proven else None


def _whole_lines(size: int) -> int:
    """zenoh refuses a pool that is no multiple of its alignment."""
    return -(-size // 64) * 64


def _require_space(size: int) -> None:
    stat = os.statvfs(_SHM)
    free = stat.f_bavail * stat.f_frsize
    if free < size:
        raise UserError(
            f"{_SHM} has {free / 1e6:.0f} MB free and {size / 1e6:.0f} MB are needed; "
            f"enlarge it (mount -o remount,size=2G {_SHM}; in a container: --shm-size=2g)"
        )
