"""Aravis' fake GigE Vision camera on loopback, in a process of its own: real packets, really lost."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass

PROGRAM = """
import sys, gi
gi.require_version("Aravis", "0.8")
from gi.repository import Aravis
camera = Aravis.GvFakeCamera.new("127.0.0.1", "GV01")
camera.set_property("gvsp-lost-ratio", float(sys.argv[1]))
print("running" if camera.is_running() else "not running", flush=True)
sys.stdin.readline()
"""


@dataclass
class FakeGige:
    process: subprocess.Popen[str]
    address: str = "127.0.0.1"

    def unplug(self) -> None:
        self.process.kill()
        self.process.wait()


@contextlib.contextmanager
def running(lost_ratio: float = 0.0) -> Iterator[FakeGige]:
    """The camera listens when this returns."""
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(lost_ratio)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    with process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            said = process.stdout.readline().strip()
            assert said == "running", f"the fake camera is {said or 'gone'}; is port 3956 taken?"
            yield FakeGige(process)
        finally:
            process.kill()
