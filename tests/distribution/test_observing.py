"""What others are told of a rig: systemd, Prometheus, and the table of all hosts."""

from __future__ import annotations

import io
import json
import math
import os
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from dataclasses import replace
from pathlib import Path

import pytest
import scans
from hypothesis import given
from hypothesis import strategies as st
from one_machine import LIMIT_S, rig_of
from rich.console import Console

from endo3d.schemas.messages import ServiceState, Status
from endo3d.services.cli.top import Board, _table
from endo3d.services.metrics import Metrics, MetricsConfig, exposition
from endo3d.services.runtime.bus import Bus
from endo3d.services.runtime.notify import Notifier

STATUS = next(message for message in scans.messages(1) if isinstance(message, Status))


@pytest.fixture
def systemd(tmp_path: Path) -> socket.socket:
    """The socket that systemd listens at."""
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    listener.bind(str(tmp_path / "notify"))
    listener.settimeout(LIMIT_S)
    return listener


def hear(listener: socket.socket, word: str) -> str:
    """The next message with that word; others may come before it."""
    while word not in (text := listener.recv(4096).decode()):
        pass
    return text


def test_systemd_hears_ready_alive_and_stopping(systemd: socket.socket, tmp_path: Path) -> None:
    """From a real stack of one service, watched."""
    (tmp_path / "stack.toml").write_text(f'[rig]\nname = "{rig_of("notify")}"\n[viewer]\nmodule = "acting.scanner"\n')
    told = {"NOTIFY_SOCKET": systemd.getsockname(), "WATCHDOG_USEC": "200000"}
    up = subprocess.Popen(
        [sys.executable, "-m", "endo3d.services.cli.app", "up", str(tmp_path / "stack.toml")],
        cwd=Path(__file__).parent,
        env={**os.environ, **told},
        stderr=subprocess.DEVNULL,
    )
    try:
        assert "STATUS=started viewer" in hear(systemd, "READY=1")
        hear(systemd, "WATCHDOG=1")
        hear(systemd, "WATCHDOG=1")
        up.send_signal(signal.SIGTERM)
        hear(systemd, "STOPPING=1")
        assert up.wait(LIMIT_S) == 0
    finally:
        up.kill()
        up.wait()
        systemd.close()


def test_logs_are_one_json_object_per_event(tmp_path: Path) -> None:
    """The services', tracebacks too, and the launcher's own; no other line."""
    (tmp_path / "failing.py").write_text(
        "from endo3d.services.runtime.service import Config, Service\n"
        "class Failing(Service[Config]):\n"
        "    def warm(self):\n"
        "        raise RuntimeError('no\\nluck')\n"
    )
    (tmp_path / "package").mkdir()
    (tmp_path / "failing.py").rename(tmp_path / "package" / "failing.py")
    (tmp_path / "stack.toml").write_text(f'[rig]\nname = "{rig_of("json")}"\n[broken]\nmodule = "package.failing"\n')
    up = subprocess.Popen(
        [sys.executable, "-m", "endo3d.services.cli.app", "up", "stack.toml", "--log", "json"],
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert up.stderr is not None
    try:
        events = []
        for line in up.stderr:
            events.append(json.loads(line))
            if "restart 1 of" in events[-1]["message"]:
                break
    finally:
        up.kill()
        up.stderr.close()
        up.wait()
    assert {event["service"] for event in events} == {"broken"}
    failure = next(event for event in events if event.get("level") == "error")
    assert "RuntimeError: no\nluck" in failure["exception"]
    assert failure["file"] == "run.py"


def test_nothing_is_said_where_nobody_asks() -> None:
    notifier = Notifier({})
    notifier.ready("started")
    notifier.alive()
    notifier.stopping()


def test_prometheus_reads_every_service_on_the_loopback() -> None:
    metrics = Metrics(MetricsConfig(port=0))
    metrics.open()
    try:
        list(metrics.step(replace(STATUS, service="decoder", host="rig", dropped={"frame:missed": 3})))
        list(metrics.step(replace(STATUS, service="viewer", host="desk", latency_p50_ms=math.nan)))
        with urllib.request.urlopen(f"http://127.0.0.1:{metrics.port}/metrics", timeout=LIMIT_S) as page:
            text = page.read().decode()
        with pytest.raises(urllib.error.HTTPError) as missing:
            urllib.request.urlopen(f"http://127.0.0.1:{metrics.port}/etc", timeout=LIMIT_S)
        missing.value.close()
        assert missing.value.code == 404
    finally:
        metrics.close()
    assert 'endo3d_rate_hz{host="rig",service="decoder"} 25.0' in text
    assert 'endo3d_dropped_total{host="rig",service="decoder",what="frame:missed"} 3' in text
    assert 'endo3d_latency_p50_ms{host="desk",service="viewer"} NaN' in text
    assert 'endo3d_state{host="rig",service="decoder",state="running"} 1' in text


@given(st.text(), st.text(), st.floats())
def test_no_name_breaks_the_format(service: str, note: str, value: float) -> None:
    """One sample per line, whatever somebody calls a figure."""
    text = exposition({"a": replace(STATUS, service=service, values={note: value})})
    samples = [line for line in text.split("\n") if line and not line.startswith("#")]
    assert len(samples) == 5 + len(ServiceState) + 1
    assert all(line.startswith("endo3d_") and line.rpartition(" ")[2] for line in samples)


def test_top_shows_all_hosts_and_counts_latency_by_the_rigs_clock() -> None:
    with Bus.open(rig_of("top"), name="top") as bus:
        board = Board(bus)
        values = {"clock_offset_ms": 3000.0, "round_trip_ms": 0.8, "mbit_s to rig": 1.25}
        board.statuses = {
            "decoder": replace(STATUS, service="decoder", host="rig", latency_p50_ms=9.0),
            "viewer": replace(STATUS, service="viewer", host="desk", latency_p50_ms=-2988.0, latency_p99_ms=-2980.0),
            "relay-desk": replace(STATUS, service="relay-desk", host="desk", values=values),
        }
        console = Console(file=io.StringIO(), width=160)
        console.print(_table(board, "bench"))
        shown = console.file.getvalue()  # type: ignore[attr-defined]
    viewer = next(line for line in shown.splitlines() if " viewer " in line).split()
    assert viewer[0] == "desk"
    assert "12.0" in viewer, "three seconds behind, and twelve milliseconds late"
    assert "20.0" in viewer
    assert "desk: clock -3000.00 ms (+-0.40 ms), 1.2 Mbit/s to rig" in shown
