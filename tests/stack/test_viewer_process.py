"""The viewer in a process of its own, on a running bus: a stalled Rerun is nobody else's problem."""

from __future__ import annotations

import os
import queue
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import psutil
import pytest
from bus_peers import wait_for
from peers import new_rig
from scans import messages

from endo3d.schemas import topics
from endo3d.schemas.messages import Frame, Message, ServiceState, Status
from endo3d.services.runtime.bus import Bus

VIEWER = """
import sys
from endo3d.services.runtime import runner
from endo3d.services.viewer import Viewer, ViewerConfig
config = ViewerConfig(show="web", port=0, web_port=0)
sys.exit(runner.run(Viewer(config), rig=sys.argv[1], name="viewer"))
"""
SHAPE = (600, 960)


@pytest.fixture
def bus() -> Iterator[Bus]:
    with Bus.open(new_rig(), name="writer") as opened:
        yield opened


@pytest.fixture
def viewer(bus: Bus) -> Iterator[psutil.Process]:
    command = [sys.executable, "-c", VIEWER, bus.rig]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        wait_for(bus, "viewer")
        yield psutil.Process(process.pid)
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=90) == 0


def publish(bus: Bus, seconds: float, hz: float = 60.0) -> float:
    """Paced frames and all that goes with them, stamped now; the longest time one of them took, in seconds."""
    longest, start = 0.0, time.monotonic()
    for message in messages(int(seconds * hz), hz, SHAPE):
        if isinstance(message, Frame):
            time.sleep(max(0.0, start + message.sequence / hz - time.monotonic()))
            image = bus.loan(topics.FRAME, SHAPE, np.uint8)
            image[:] = message.image
            message = replace(message, image=image)
        before = time.perf_counter()
        bus.publish(replace(message, stamp_ns=time.time_ns()))
        longest = max(longest, time.perf_counter() - before)
    return longest


def test_a_stalled_rerun_slows_no_writer_and_is_reported(bus: Bus, viewer: psutil.Process) -> None:
    statuses: queue.Queue[Message] = queue.Queue()
    bus.subscribe(topics.STATUS, statuses.put)
    publish(bus, 1.0)
    (rerun,) = (child for child in viewer.children() if child.name() == "rerun")
    os.kill(rerun.pid, signal.SIGSTOP)
    assert publish(bus, 4.0) < 20.0  # the stopped Rerun would hold it up for ever
    assert not any(cause.endswith("exhausted") for cause in bus.tally.dropped)
    note = ""
    while "doesn't take what it gets" not in note:
        status = statuses.get(timeout=90)
        assert isinstance(status, Status)
        note = status.note
    assert status.state is ServiceState.DEGRADED
