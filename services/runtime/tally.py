"""What a process counts: messages in, messages out, messages lost and why."""

from __future__ import annotations

import threading
from collections import Counter
from dataclasses import dataclass, field


@dataclass
class Tally:
    """Counts since start, per topic; ``dropped`` per ``topic:cause``. Any thread may count."""

    received: Counter[str] = field(default_factory=Counter)
    published: Counter[str] = field(default_factory=Counter)
    dropped: Counter[str] = field(default_factory=Counter)
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    def receive(self, topic: str) -> None:
        with self._lock:
            self.received[topic] += 1

    def publish(self, topic: str) -> None:
        with self._lock:
            self.published[topic] += 1

    def drop(self, topic: str, cause: str, count: int = 1) -> None:
        with self._lock:
            self.dropped[f"{topic}:{cause}"] += count

    def snapshot(self) -> tuple[dict[str, int], dict[str, int], dict[str, int]]:
        """Copies of received, published, dropped."""
        with self._lock:
            return dict(self.received), dict(self.published), dict(self.dropped)
