"""Arrays that begin on a cache line: a vector that straddles two costs twice, numpy aligns to 16 bytes only."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

LINE_BYTES = 64


def zeros(shape: int | tuple[int, ...], dtype: DTypeLike = np.float32) -> NDArray[Any]:
    """``numpy.zeros``, C-contiguous, aligned to 64 bytes."""
    wanted, kind = (shape,) if isinstance(shape, int) else shape, np.dtype(dtype)
    size = math.prod(wanted) * kind.itemsize
    memory = np.zeros(size + LINE_BYTES, np.uint8)
    start = -memory.ctypes.data % LINE_BYTES
    return memory[start : start + size].view(kind).reshape(wanted)
