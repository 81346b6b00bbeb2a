"""Hosts on one machine: a network namespace each, joined by a switch; links that can be slow, lossy, or cut."""

from __future__ import annotations

import ctypes
import os
import shutil
import signal
import subprocess
import sys
import uuid
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any, Self

PR_SET_PDEATHSIG = 1
_BURST_MS = 20
"""Of a token bucket: what the system's timer may be late by."""


def _die_with_parent() -> None:
    """In a child: nothing is left running, however this process ends."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)


def obstacle() -> str:
    """Why namespaces can't be made here; empty when they can."""
    if shutil.which("ip") is None or shutil.which("tc") is None:
        return "ip and tc (iproute2) are not installed"
    name = f"e3d{uuid.uuid4().hex[:6]}"
    made = subprocess.run(["ip", "netns", "add", name], capture_output=True, text=True, check=False)
    if made.returncode:
        return f"may not make network namespaces: {made.stderr.strip()}"
    subprocess.run(["ip", "netns", "del", name], capture_output=True, check=False)
    return ""


class Network:
    """Namespaces of the given names, each with ``eth0`` at 10.77.0.1, .2 ... A context manager: nothing is left."""

    def __init__(self, *names: str) -> None:
        self.names = names
        self.address = {name: f"10.77.0.{number}" for number, name in enumerate(names, 1)}
        self._prefix = f"e3d{uuid.uuid4().hex[:5]}"
        self._switch = f"{self._prefix}-switch"
        self._processes: list[subprocess.Popen[Any]] = []

    def __enter__(self) -> Self:
        self._ip("netns", "add", self._switch)
        self._in(self._switch, "ip", "link", "add", "br0", "type", "bridge")
        self._in(self._switch, "ip", "link", "set", "br0", "up")
        for name in self.names:
            space = self.space(name)
            self._ip("netns", "add", space)
            # The far end goes through a second pair, so that a wire can be put between the two.
            self._in(self._switch, "ip", "link", "add", name, "type", "veth", "peer", "name", "eth0", "netns", space)
            self._in(self._switch, "ip", "link", "set", name, "master", "br0", "up")
            self._in(space, "ip", "address", "add", f"{self.address[name]}/24", "dev", "eth0")
            self._in(space, "ip", "link", "set", "eth0", "up")
            self._in(space, "ip", "link", "set", "lo", "up")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for process in self._processes:
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
        for process in self._processes:
            try:
                process.wait(30)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
            if process.stdout is not None:
                process.stdout.close()
        for space in (self._switch, *map(self.space, self.names)):
            subprocess.run(["ip", "netns", "del", space], capture_output=True, check=False)

    def space(self, name: str) -> str:
        return f"{self._prefix}-{name}"

    def start(
        self, name: str, command: Sequence[str], environment: Mapping[str, str] | None = None, **options: Any
    ) -> subprocess.Popen[Any]:
        """Run a command on a host; it ends with the network at the latest."""
        process = subprocess.Popen(
            ["ip", "netns", "exec", self.space(name), *command],
            env={**os.environ, **(environment or {})},
            start_new_session=True,
            preexec_fn=_die_with_parent,
            **options,
        )
        self._processes.append(process)
        return process

    def limit(self, name: str, mbit_s: float) -> None:
        """Both directions of a host's link carry that much."""
        burst_bytes = max(20_000, round(mbit_s * 1e6 / 8 * _BURST_MS / 1e3))
        shape = ("root", "tbf", "rate", f"{mbit_s:g}mbit", "burst", str(burst_bytes), "latency", "50ms")
        self._in(self._switch, "tc", "qdisc", "replace", "dev", name, *shape)
        self._in(self.space(name), "tc", "qdisc", "replace", "dev", "eth0", *shape)

    def worsen(self, name: str, *, delay_ms: float = 0.0, loss: float = 0.0) -> str:
        """Delay and lose packets both ways: by netem where the kernel has it, else by a wire in user space.

        Returns which of the two it was.
        """
        shape = ("root", "netem", "delay", f"{delay_ms:g}ms", "loss", f"{100 * loss:g}%", "limit", "100000")
        sides = ((self._switch, name), (self.space(name), "eth0"))
        commands = [self._command(space, "tc", "qdisc", "replace", "dev", device, *shape) for space, device in sides]
        if all(subprocess.run(command, capture_output=True, check=False).returncode == 0 for command in commands):
            return "netem"
        self._put_wire(name, delay_ms, loss)
        return "wire"

    def cut(self, name: str) -> None:
        """Pull a host's cable."""
        self._in(self._switch, "ip", "link", "set", name, "nomaster")

    def mend(self, name: str) -> None:
        """Plug it in again."""
        self._in(self._switch, "ip", "link", "set", name, "master", "br0")

    def _put_wire(self, name: str, delay_ms: float, loss: float) -> None:
        end, port = f"{name[:8]}-w", f"{name[:8]}-p"
        self._in(self._switch, "ip", "link", "set", name, "nomaster")
        self._in(self._switch, "ip", "link", "add", end, "type", "veth", "peer", "name", port)
        self._in(self._switch, "ip", "link", "set", port, "master", "br0", "up")
        self._in(self._switch, "ip", "link", "set", end, "up")
        # One packet at a time: a loss is of one packet, as on a real link.
        self._in(self.space(name), "ip", "link", "set", "eth0", "gso_max_segs", "1")
        self._in(self._switch, "ip", "link", "set", port, "gso_max_segs", "1")
        wire = [sys.executable, "-m", "bench.hosts.wire", name, end, f"{delay_ms}", f"{loss}"]
        command = ["ip", "netns", "exec", self._switch, *wire]
        process = subprocess.Popen(
            command, start_new_session=True, preexec_fn=_die_with_parent, stdout=subprocess.PIPE
        )
        self._processes.append(process)
        assert process.stdout is not None
        process.stdout.readline()  # it is in place

    def _in(self, space: str, *command: str) -> None:
        self._run(self._command(space, *command))

    def _ip(self, *arguments: str) -> None:
        self._run(["ip", *arguments])

    @staticmethod
    def _command(space: str, *command: str) -> list[str]:
        return ["ip", "netns", "exec", space, *command]

    @staticmethod
    def _run(command: Sequence[str]) -> None:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise OSError(f"{' '.join(command)}: {done.stderr.strip()}")
