"""A hash table from voxel keys to row numbers: open addressing that keeps neighbours along x together.

Deleting shifts the followers back, so there are no tombstones and never a rebuild. Keys are three signed 16-bit
numbers packed into 48 bits; an empty slot holds -1.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d_core.compiled import kernel

EMPTY = -1
OFFSET = 32768
"""What makes a signed number of the key positive."""


@kernel
def pack(kx: Any, ky: Any, kz: Any) -> Any:
    """Three keys within +-32767 -> one."""
    return ((np.int64(kx) + OFFSET) << 32) | ((np.int64(ky) + OFFSET) << 16) | (np.int64(kz) + OFFSET)


@kernel
def unpack(key: int) -> tuple[int, int, int]:
    return ((key >> 32) & 0xFFFF) - OFFSET, ((key >> 16) & 0xFFFF) - OFFSET, (key & 0xFFFF) - OFFSET


@kernel
def home(key: int, mask: int) -> Any:
    """Eight voxels in a row along x share a cache line; rows scatter (Fibonacci hashing)."""
    row = ((key >> 35) << 32) | (key & 0xFFFFFFFF)
    scattered = np.uint64(row) * np.uint64(0x9E3779B97F4A7C15)
    return np.int64(((scattered >> np.uint64(20)) << np.uint64(3)) | np.uint64((key >> 32) & 7)) & mask


@kernel
def find(keys: NDArray[np.int64], rows: NDArray[np.int32], key: int) -> Any:
    """The key's row, or -1."""
    mask = keys.size - 1
    slot = home(key, mask)
    while keys[slot] != EMPTY:
        if keys[slot] == key:
            return np.int64(rows[slot])
        slot = (slot + 1) & mask
    return -1


@kernel
def insert(keys: NDArray[np.int64], rows: NDArray[np.int32], key: int, row: int) -> None:
    """Adds a key that is not there; the caller keeps the table at most half full."""
    mask = keys.size - 1
    slot = home(key, mask)
    while keys[slot] != EMPTY:
        slot = (slot + 1) & mask
    keys[slot] = key
    rows[slot] = row


@kernel
def remove(keys: NDArray[np.int64], rows: NDArray[np.int32], key: int) -> None:
    """Removes a key that is there (Knuth 6.4, algorithm R)."""
    mask = keys.size - 1
    hole = home(key, mask)
    while keys[hole] != key:
        hole = (hole + 1) & mask
    slot = hole
    while True:
        slot = (slot + 1) & mask
        if keys[slot] == EMPTY:
            break
        # A follower may fill the hole unless its home lies behind the hole.
        if ((slot - home(keys[slot], mask)) & mask) >= ((slot - hole) & mask):
            keys[hole], rows[hole] = keys[slot], rows[slot]
            hole = slot
    keys[hole] = EMPTY
