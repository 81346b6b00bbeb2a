"""Frames shared out between decoders on several hosts, a piece to each in turn.

A piece is a run of frames that one decoder gets whole: whole sequences of patterns, many for the continuous modes.
A window reaches back over a piece's start, so the decoder also gets the frames just before its piece; it sees a
gap in front of those and starts a new window there. The stock decoder needs to know nothing of all this.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection
from functools import lru_cache
from typing import Final

from endo3d.schemas.messages import Frame
from endo3d_core import patterns

PIECE_FRAMES: Final = 48
"""About how many frames a piece has: of its results, those of the frames before it are decoded twice."""
_REMEMBERED: Final = 8
"""Pieces: more than are ever under way at once."""


class Shares:
    """Whose frame is this? Deterministic, so that the line to every decoder can decide by itself."""

    def __init__(
        self, hosts: Collection[str], is_there: Callable[[str], bool], piece_frames: int = PIECE_FRAMES
    ) -> None:
        """is_there: whether a host's decoder can take frames; the pieces of one that can't go to the others."""
        self._hosts = tuple(hosts)
        self._is_there = is_there
        self._piece_frames = piece_frames
        self._owners: dict[int, str] = {}
        self._lock = threading.Lock()

    def owner(self, piece: int) -> str:
        """Who decodes a piece. Decided once, when its first frame comes."""
        with self._lock:
            if piece not in self._owners:
                there = [host for host in self._hosts if self._is_there(host)] or self._hosts
                self._owners[piece] = there[piece % len(there)]
                for old in [number for number in self._owners if abs(number - piece) > _REMEMBERED]:
                    del self._owners[old]
            return self._owners[piece]

    def takes(self, host: str, frame: Frame) -> bool:
        """Whether ``host`` needs this frame: as part of its piece, or in a window that reaches into it."""
        period, reach = _period_and_reach(frame.pattern_set)
        piece_frames = max(1, self._piece_frames // period) * period
        start = frame.sequence - max(frame.slot, 0)  # of this sequence of patterns: pieces begin with slot 0
        piece, within = start // piece_frames, start % piece_frames + max(frame.slot, 0)
        return any(self.owner(piece + ahead) == host for ahead in range(1 + (within + reach) // piece_frames))


@lru_cache(maxsize=16)
def _period_and_reach(pattern_set: str) -> tuple[int, int]:
    """Frames of a sequence of patterns, and how many before a frame can be in its window."""
    known = patterns.parse(pattern_set)
    return len(known), 0 if known.kind == "conventional" else 2 * len(known)
