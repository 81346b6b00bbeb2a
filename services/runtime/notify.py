"""What systemd wants to know of a ``Type=notify`` unit: ready, alive, stopping. Nothing where it does not ask."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Mapping


class Notifier:
    """Speaks sd_notify: one datagram of ``NAME=value`` lines to the socket that systemd names."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        path = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + path[1:] if path.startswith("@") else path
        self._period_s = int(environment.get("WATCHDOG_USEC", "0")) / 2e6
        """Half of what systemd waits for a sign of life."""
        self._due_s = 0.0

    def ready(self, status: str) -> None:
        """All services are started."""
        self._send(f"READY=1\nSTATUS={status}")

    def alive(self) -> None:
        """To be called in every turn of the main loop; says so as often as it has to."""
        if self._period_s and time.monotonic() >= self._due_s:
            self._due_s = time.monotonic() + self._period_s
            self._send("WATCHDOG=1")

    def stopping(self) -> None:
        self._send("STOPPING=1")

    def _send(self, text: str) -> None:
        if self._address:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as speaker:
                speaker.sendto(text.encode(), self._address)
