"""The Rerun program beside us: a window, or a server for browsers, on the loopback interface only."""

from __future__ import annotations

import importlib.util
import os
import socket
import subprocess
import sys
import time
from pathlib import Path
from urllib.parse import quote

from endo3d.services.runtime.errors import UserError

HOST = "127.0.0.1"
START_S = 15.0
KEPT_FOR_LATECOMERS = "256MB"
"""What a browser that comes late is sent at once."""


def executable() -> Path:
    """The viewer itself. The ``rerun`` script is a wrapper: ending that would leave this running."""
    spec = importlib.util.find_spec("rerun_cli")
    folder = Path(spec.origin).parent if spec and spec.origin else Path()
    path = folder / ("rerun.exe" if sys.platform == "win32" else "rerun")
    if not path.is_file():
        raise UserError("the Rerun viewer is not installed; pip install rerun-sdk")
    return path


def has_display() -> bool:
    """Whether a window could open."""
    return sys.platform in ("win32", "darwin") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def free_port(wanted: int) -> int:
    """``wanted``, or any free one for 0. Raises ``UserError`` when it is taken."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, wanted))
        except OSError as error:
            raise UserError(f"port {wanted} is busy; give the viewer another one (0 takes any free port)") from error
        return int(probe.getsockname()[1])


class ViewerProcess:
    """A running Rerun program and its address."""

    def __init__(self, port: int = 0, web_port: int | None = None, arguments: tuple[str, ...] = ()) -> None:
        self.port = free_port(port)
        self.web_port = None if web_port is None else free_port(web_port)
        web: tuple[str, ...] = ()
        if self.web_port is not None:
            kept = ("--server-memory-limit", KEPT_FOR_LATECOMERS)
            web = ("--serve-web", "--web-viewer-port", str(self.web_port), *kept)
        self._command = [str(executable()), "--bind", HOST, "--port", str(self.port), *web, *arguments]
        self._process = self._start()

    @property
    def url(self) -> str:
        """Where the SDK and other viewers connect."""
        return f"rerun+http://{HOST}:{self.port}/proxy"

    @property
    def page(self) -> str:
        """Where a browser looks; empty for a window."""
        return "" if self.web_port is None else f"http://{HOST}:{self.web_port}/?url={quote(self.url, safe='')}"

    @property
    def pid(self) -> int:
        return self._process.pid

    def alive(self) -> bool:
        return self._process.poll() is None

    def revive(self) -> bool:
        """Start the server of a page again if it ended; whoever closed a window wants no other."""
        if self.alive():
            return True
        if not self.page:
            return False
        self._process = self._start()
        return True

    def wait(self) -> int:
        """Until it is closed."""
        return self._process.wait()

    def stop(self) -> None:
        """End it, stalled or not."""
        self._process.terminate()
        try:
            self._process.wait(1.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _start(self) -> subprocess.Popen[bytes]:
        quiet = {"RUST_LOG": "error", **os.environ}
        process = subprocess.Popen(
            self._command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=quiet,
        )
        deadline = time.monotonic() + START_S
        while time.monotonic() < deadline and process.poll() is None:
            with socket.socket() as probe:
                probe.settimeout(0.2)
                if probe.connect_ex((HOST, self.port)) == 0:
                    return process
            time.sleep(0.02)
        process.kill()
        process.wait()
        raise UserError(f"the Rerun viewer doesn't start: try {' '.join(self._command)}")
