"""How far another host's clock is ahead of ours, from questions and answers."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple


class Exchange(NamedTuple):
    """One question: asked and answered by our clock, and what the other clock said in between."""

    asked_ns: int
    theirs_ns: int
    answered_ns: int

    @property
    def round_trip_ns(self) -> int:
        return self.answered_ns - self.asked_ns

    @property
    def offset_ns(self) -> int:
        """Theirs minus ours, if both ways take as long; wrong by half the round trip at most."""
        return self.theirs_ns - (self.asked_ns + self.answered_ns) // 2


class Offset:
    """The offset by the quickest of the last exchanges: queues make a way longer, never shorter (RFC 5905, 10)."""

    def __init__(self, exchanges: int = 60) -> None:
        self._exchanges: deque[Exchange] = deque(maxlen=exchanges)

    def add(self, exchange: Exchange) -> None:
        self._exchanges.append(exchange)

    @property
    def best(self) -> Exchange | None:
        return min(self._exchanges, key=lambda exchange: exchange.round_trip_ns, default=None)

    @property
    def offset_ns(self) -> int:
        """Theirs minus ours; 0 before the first exchange."""
        return self.best.offset_ns if self.best is not None else 0
