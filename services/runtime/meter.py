"""How a service does: rate, latency, processor, memory; what its status says once a second."""

from __future__ import annotations

import os
import socket
import threading
import time
from typing import Final

import numpy as np
import psutil

_WINDOW: Final = 2_048
"""Steps that the percentiles are of: about eleven seconds at the camera's rate."""


class Meter:
    """Counts steps and their latencies; any thread may count."""

    def __init__(self, host: str = "") -> None:
        """host: its name in the stack file; by default the machine's own."""
        self.host = host or socket.gethostname()
        self.pid = os.getpid()
        self._process = psutil.Process()
        self._process.cpu_percent()
        self._latency_ms = np.full(_WINDOW, np.nan, np.float32)
        self._steps = 0
        self._seen = 0
        self._since_s = time.monotonic()
        self._lock = threading.Lock()

    def step(self, latency_ns: int) -> None:
        """One step on the main input, or one message of a source."""
        with self._lock:
            self._latency_ms[self._steps % _WINDOW] = latency_ns * 1e-6
            self._steps += 1

    def rate_hz(self) -> float:
        """Steps per second since the last call."""
        now_s = time.monotonic()
        with self._lock:
            steps, seconds = self._steps - self._seen, now_s - self._since_s
            self._seen, self._since_s = self._steps, now_s
        return steps / seconds if seconds > 0 else 0.0

    def latency_ms(self) -> tuple[float, float]:
        """(p50, p99) of the last steps; NaN before the first."""
        with self._lock:
            known = self._latency_ms[: min(self._steps, _WINDOW)].copy()
        if known.size == 0:
            return float("nan"), float("nan")
        p50, p99 = np.percentile(known, (50, 99))
        return float(p50), float(p99)

    def cpu_share(self) -> float:
        """Of one core, since the last call."""
        return float(self._process.cpu_percent()) / 100

    def memory_mb(self) -> float:
        """Private memory: every process maps the others' shared pools, which would count them many times."""
        memory = self._process.memory_info()
        return float(memory.rss - memory.shared) / 1e6
