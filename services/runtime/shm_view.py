"""A numpy view of zenoh's shared memory, without a copy.

zenoh's Python objects have no buffer protocol: their public API copies 2.3 MB in 250 us each way. But
pointer and length of the memory stand inside the Python object. Where, is found at start by searching an
object whose length and content are known; only addresses inside a mapped ``/dev/shm/*.zenoh`` are ever
read. When the search finds no single answer (another zenoh release) the caller uses the copying API; a
release with a buffer protocol is used through ``memoryview``.
"""

from __future__ import annotations

import ctypes
import os
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from zenoh.shm import ZShm, ZShmMut

_WORD: Final = ctypes.sizeof(ctypes.c_void_p)
_PROBE_BYTES: Final = 4099
"""A prime, so that no other field of the object is likely to hold it."""


class Chunk:
    """A piece of shared memory. It is the base of the arrays over it and so lives as long as any of them."""

    __slots__ = ("__array_interface__", "__weakref__", "backing", "owner", "size")

    def __init__(
        self,
        owner: ZShm | ZShmMut,
        size: int,
        address: int,
        backing: NDArray[np.uint8] | None = None,
    ) -> None:
        """``backing``: ordinary memory at ``address``, in the owner's place when there is no view."""
        self.owner: ZShm | ZShmMut | None = owner
        self.size = size
        self.backing = backing
        self.__array_interface__ = {
            "version": 3,
            "shape": (size,),
            "typestr": "|u1",
            "data": (address, isinstance(owner, ZShm)),
        }

    def array(self) -> NDArray[np.uint8]:
        """(size,) uint8 over the memory; writable while it is on loan."""
        return np.asarray(self)

    def is_valid(self) -> bool:
        """False when the writer took the memory back: what was computed from it is void."""
        return not isinstance(self.owner, ZShm) or self.owner.is_valid()


class View:
    """Chunks over shared memory objects, once their layout is known."""

    def __init__(self, pointer_offset: int | None) -> None:
        """``pointer_offset``: bytes from the object's start to its pointer; None is the buffer protocol."""
        self._pointer_offset = pointer_offset

    def __call__(self, owner: ZShm | ZShmMut, size: int) -> Chunk:
        return Chunk(owner, size, self._address(owner))

    def _address(self, owner: ZShm | ZShmMut) -> int:
        if self._pointer_offset is None:
            buffer: Any = owner
            return address_of(np.frombuffer(memoryview(buffer), np.uint8))
        return ctypes.c_size_t.from_address(id(owner) + self._pointer_offset).value


def copy_of(owner: ZShmMut, size: int) -> Chunk:
    """The same without a view: ordinary memory that the seal copies through the public API."""
    backing = np.empty(size, np.uint8)
    return Chunk(owner, size, address_of(backing), backing)


def address_of(array: NDArray[Any]) -> int:
    """Where an array's memory starts."""
    return int(array.__array_interface__["data"][0])


def chunk_of(array: NDArray[Any]) -> Chunk | None:
    """The chunk an array is a view of, if it is one."""
    base: Any = array
    while isinstance(base, np.ndarray):
        base = base.base
    return base if isinstance(base, Chunk) else None


def find_view(owner: ZShmMut, content: bytes) -> View | None:
    """The view that leads from ``owner`` to its known ``content``; None when there is no single one."""
    buffer: Any = owner
    try:
        memoryview(buffer)
    except TypeError:
        offsets = _pointer_offsets(owner, content)
        return View(offsets[0]) if len(offsets) == 1 else None
    return View(None)


def probe_content() -> bytes:
    """What the object that ``find_view`` is given must hold: random, so that only the true address has it."""
    return os.urandom(_PROBE_BYTES)


def _pointer_offsets(owner: ZShmMut, content: bytes) -> list[int]:
    """Offsets of all words that point to ``content`` and are followed by its length."""
    size = type(owner).__basicsize__
    words = np.frombuffer(ctypes.string_at(id(owner), size // _WORD * _WORD), np.uintp)
    mapped = _mapped_segments()
    return [
        index * _WORD
        for index in range(len(words) - 1)
        if int(words[index + 1]) == len(content)
        and any(start <= int(words[index]) <= stop - len(content) for start, stop in mapped)
        and ctypes.string_at(int(words[index]), len(content)) == content
    ]


def _mapped_segments() -> list[tuple[int, int]]:
    """Address ranges of this process that are zenoh's shared memory."""
    with open("/proc/self/maps") as maps:
        ranges = [line.split()[0] for line in maps if line.rstrip().endswith(".zenoh")]
    return [(int(start, 16), int(stop, 16)) for start, stop in (text.split("-") for text in ranges)]
