"""Results of several decoders, back in the order of their frames."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Final

from endo3d.schemas.messages import Cloud, DepthMap

HOLD_NS: Final = 150_000_000
"""How long a result waits for one before it, that may be lost: the price of a lost piece, once."""
_ANEW: Final = 500
"""A step back by more than this is no late result: the rig began to count anew."""


class InOrder:
    """Gives results on in order of ``sequence``, each once: where pieces meet, two decoders have the same ones."""

    def __init__(self, hold_ns: int = HOLD_NS) -> None:
        self.late = 0
        """Results lost because later ones had been given on already."""
        self._hold_ns = hold_ns
        self._last: int | None = None
        self._stride = 0
        self._given: deque[int] = deque(maxlen=_ANEW)
        self._held: dict[int, tuple[int, Cloud | DepthMap]] = {}

    def add(self, result: Cloud | DepthMap, now_ns: int) -> Iterator[Cloud | DepthMap]:
        """One result in, those out whose turn it is."""
        if result.sequence in self._given or result.sequence in self._held:
            return
        if self._last is not None and result.sequence <= self._last:
            if self._last - result.sequence < _ANEW:
                self.late += 1
                return
            self._last, self._stride, self._held = None, 0, {}
            self._given.clear()
        self._held[result.sequence] = now_ns, result
        yield from self.due(now_ns)

    def due(self, now_ns: int) -> Iterator[Cloud | DepthMap]:
        """What may be given on now: the next in sequence, or what has waited for it long enough."""
        while self._held:
            sequence = min(self._held)
            since_ns = self._held[sequence][0]
            if not self._is_next(sequence) and now_ns - since_ns < self._hold_ns:
                return
            if self._last is not None:
                step = sequence - self._last
                self._stride = min(self._stride or step, step)
            self._last = sequence
            self._given.append(sequence)
            yield self._held.pop(sequence)[1]

    def _is_next(self, sequence: int) -> bool:
        return self._last is None or self._stride == 0 or sequence - self._last <= self._stride
