"""Where outgoing messages are put: shared memory for large ones, plain bytes for small ones."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import DTypeLike, NDArray
from zenoh import ZBytes

from endo3d.schemas import codec
from endo3d.schemas.messages import Message
from endo3d.schemas.topics import Topic
from endo3d.services.runtime.pool import Pool, is_loan, seal
from endo3d.services.runtime.service import Exhausted
from endo3d.services.runtime.shm_view import Chunk, View, address_of, chunk_of

_SMALL_BYTES: Final = 3_072
"""Below this a message travels in the descriptor's place, which is cheaper than a chunk."""
_COMMON_CHUNK_BYTES: Final = 1 << 20
"""Of the pool for everything that is neither small nor bulk: map deltas, calibrations."""
_SETTLE_S: Final = 0.5
_PIECE_BYTES: Final = 64
"""Of every new pool, offered to readers to map it by."""


class Memory:
    """Lends arrays in shared memory and makes payloads of messages. Bulk topics have a pool each."""

    def __init__(self, view: View | None, offer: Callable[[Topic, ZBytes], None]) -> None:
        """``view`` None: no zero-copy view, chunks are filled through zenoh's copying API.

        ``offer`` is given a piece of every pool of a bulk topic as soon as it exists.
        """
        self._view = view
        self._offer = offer
        self._pools: dict[Topic | None, Pool] = {}
        self._whole: dict[Topic | None, int] = {}
        """Chunks of each pool when none is in use."""
        self._lock = threading.Lock()

    def lend(self, topic: Topic, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """An uninitialised array that ``payload`` will not copy; raises ``Exhausted``."""
        size = codec.DATA_OFFSET + math.prod(shape) * np.dtype(dtype).itemsize
        chunk = self._pool(topic, size).take(size)
        return chunk.array()[codec.DATA_OFFSET :].view(dtype).reshape(shape)

    def payload(self, topic: Topic, message: Message) -> ZBytes | bytes:
        """What to put.

        Raises ``Exhausted`` (bulk topics only) and ``ValueError`` for a message that can't be encoded.
        """
        array = codec.array_of(message)
        if array is not None:
            chunk = _loan_of(array)
            if chunk is None:
                size = codec.encoded_size(message)
                chunk = self._pool(topic, size).take(size)
            codec.encode_into(message, chunk.array())
            return seal(chunk)
        encoded = codec.encode(message)
        if len(encoded) < _SMALL_BYTES or topic.latched:  # the cache of a latched topic would keep its chunk
            return encoded
        try:
            chunk = self._pool(topic, len(encoded)).take(len(encoded))
        except Exhausted:
            return encoded
        chunk.array()[:] = np.frombuffer(encoded, np.uint8)
        return seal(chunk)

    def settle(self) -> None:
        """Wait until readers have let go of what was published, for half a second at most.

        Shared memory ends with its process: a reader that is woken later would find nothing.
        """
        deadline = time.monotonic() + _SETTLE_S
        while time.monotonic() < deadline and self._is_looked_at():
            time.sleep(_SETTLE_S / 50)

    def _is_looked_at(self) -> bool:
        return any(pool.free() < self._whole[key] for key, pool in self._pools.items())

    def _pool(self, topic: Topic, size: int) -> Pool:
        """The topic's own pool, replaced when its messages outgrow it; or the common one."""
        key = topic if topic.bulk else None
        with self._lock:
            pool = self._pools.get(key)
            if pool is None or (topic.bulk and size > pool.chunk_bytes):
                pool = self._pools[key] = Pool(size if topic.bulk else _COMMON_CHUNK_BYTES, self._view)
                if topic.bulk:
                    self._offer(topic, seal(pool.take(_PIECE_BYTES)))
                self._whole[key] = pool.free()
            return pool


def _loan_of(array: NDArray[Any]) -> Chunk | None:
    """The loaned chunk that an array fills; None when it is anything else."""
    chunk = chunk_of(array)
    if chunk is None or not is_loan(chunk) or not array.flags.c_contiguous:
        return None
    whole = chunk.array()
    at_its_place = address_of(array) == address_of(whole) + codec.DATA_OFFSET
    return chunk if at_its_place and array.nbytes == whole.nbytes - codec.DATA_OFFSET else None
