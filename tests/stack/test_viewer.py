"""What the viewer shows, and that nothing about it can hold anybody up."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scans
from rerun.chunk import RrdReader
from scans import messages

from endo3d.schemas import messages as m
from endo3d.services.runtime.errors import UserError
from endo3d.services.viewer import Viewer, ViewerConfig
from endo3d.services.views import entries
from endo3d.services.views.blueprint import scan_blueprint
from endo3d.services.views.display import Display
from endo3d.services.views.sink import ViewerSink
from endo3d.services.views.viewer_process import ViewerProcess, free_port

HELD_UP_S = 20.0
"""A stopped viewer takes nothing ever again: who waits for it waits longer than this."""


def only(kind: type[m.Message], count: int, hz: float = 25.0) -> list[m.Message]:
    return [message for message in messages(count, hz) if isinstance(message, kind)]


def test_images_are_thinned_to_the_rate_of_an_eye_by_their_stamps() -> None:
    display = Display(rate_hz=30.0)
    shown = [entry for frame in only(m.Frame, 180, 180.0) for entry in display.show(frame)]
    assert 29 <= len([entry for entry in shown if entry.path == entries.IMAGE]) <= 31


def test_a_loop_in_time_is_shown_again() -> None:
    display = Display(rate_hz=10.0)
    first = [len(list(display.show(frame))) for frame in only(m.Frame, 10, 10.0)]
    again = [len(list(display.show(frame))) for frame in only(m.Frame, 10, 10.0)]
    assert first == again


def test_large_images_are_halved_and_the_frustum_with_them() -> None:
    display = Display()
    K = np.array([[3200.0, 0, 960], [0, 3200, 600], [0, 0, 1]])
    list(display.show(m.CameraCalibration(1, 1920, 1200, K, np.zeros(5))))
    frame = replace(only(m.Frame, 1)[0], image=np.zeros((1200, 1920), np.uint8))
    pinhole, image = display.show(frame)
    assert image.width == 960
    assert pinhole.static
    np.testing.assert_allclose(pinhole.what.resolution.as_arrow_array().to_pylist()[0], [960, 600])
    columns = pinhole.what.image_from_camera.as_arrow_array().to_pylist()[0]
    np.testing.assert_allclose(columns, [1600, 0, 0, 0, 1600, 0, 480, 300, 1])


def test_a_cloud_shows_its_valid_points_only() -> None:
    (cloud,) = only(m.Cloud, 1)
    (entry,) = Display().show(cloud)
    positions = np.array(entry.what.positions.as_arrow_array().to_pylist())
    valid = cloud.points[np.isfinite(cloud.points["z"])]
    np.testing.assert_allclose(positions[:, 2], valid["z"])
    assert len(positions) == cloud.valid_count < cloud.points.size


def test_a_lost_pose_moves_nothing() -> None:
    (pose,) = only(m.Pose, 1)
    assert list(Display().show(replace(pose, state=m.Tracking.LOST))) == []
    assert list(Display().show(pose))


def test_a_reset_clears_map_and_way_and_a_snapshot_does_not() -> None:
    display = Display()
    for message in messages():
        list(display.show(message))
    (*_, delta) = only(m.MapDelta, 6)
    snapshot = replace(delta, stamp_ns=delta.stamp_ns + 1, reset=True)
    assert {entry.path for entry in display.show(snapshot)} <= {entries.MAP}
    assert display.way
    reset = replace(snapshot, points=delta.points[:0])
    assert {entry.path for entry in display.show(reset)} == {entries.MAP, entries.WAY}
    assert not display.way
    assert list(display.map_now()) == []


def test_every_message_of_a_scan_can_be_shown() -> None:
    display = Display()
    paths = {entry.path for message in messages() for entry in display.show(message)}
    assert {entries.IMAGE, entries.CLOUD, entries.DEPTH, entries.CAMERA, entries.MAP, entries.WAY} <= paths
    assert {f"{entries.PLOTS}/rate_hz/decoder", f"{entries.PLOTS}/pose/residual_um"} <= paths


def test_a_step_yields_nothing_and_fills_the_recording(tmp_path: Path) -> None:
    path = tmp_path / "scan.rrd"
    viewer = Viewer(ViewerConfig(show="none", save=path, cloud_hz=30))
    viewer.open()
    assert [out for message in messages() for out in viewer.step(message)] == []
    viewer.close()
    chunks = RrdReader(path).stream().to_chunks()
    rows = Counter()
    for chunk in chunks:
        rows[chunk.entity_path] += chunk.num_rows
    assert {"/" + entries.MAP, "/" + entries.WAY} <= rows.keys()
    assert rows["/" + entries.CLOUD] == rows["/" + entries.DEPTH] == 6


@pytest.fixture
def rerun_server() -> Iterator[ViewerProcess]:
    server = ViewerProcess(web_port=0)
    yield server
    os.kill(server.pid, signal.SIGCONT)
    server.stop()


def feed(viewer: Viewer, seconds: float, start_s: float) -> float:
    """Steps through full-rate images and clouds of so many seconds; the longest step in seconds."""
    longest = 0.0
    for message in messages(int(60 * seconds), 60.0, (600, 960), start_s):
        before = time.perf_counter()
        list(viewer.step(message))
        longest = max(longest, time.perf_counter() - before)
    return longest


def connected(server: ViewerProcess) -> Viewer:
    viewer = Viewer(ViewerConfig(show="connect", url=server.url))
    viewer.open()
    return viewer


def test_a_stalled_viewer_holds_nobody_up_and_is_told(rerun_server: ViewerProcess) -> None:
    viewer = connected(rerun_server)
    feed(viewer, 0.5, 0.0)
    assert viewer.trouble() == ""
    os.kill(rerun_server.pid, signal.SIGSTOP)
    longest = feed(viewer, 3.0, 1.0)
    assert longest < HELD_UP_S
    assert "doesn't take what it gets" in viewer.trouble()
    assert viewer.losses()["view:not taken"] > 10
    os.kill(rerun_server.pid, signal.SIGCONT)
    deadline = time.monotonic() + 90
    start_s = 10.0
    while viewer.trouble() and time.monotonic() < deadline:
        feed(viewer, 0.5, start_s)
        start_s += 1.0
    assert viewer.trouble() == ""
    viewer.close()


def test_the_end_does_not_wait_for_a_stalled_viewer(rerun_server: ViewerProcess) -> None:
    viewer = connected(rerun_server)
    os.kill(rerun_server.pid, signal.SIGSTOP)
    feed(viewer, 2.0, 0.0)
    before = time.perf_counter()
    viewer.close()
    assert time.perf_counter() - before < HELD_UP_S


ENDS_BESIDE_A_STALLED_VIEWER = """
import os, signal, sys
from endo3d.services.viewer import Viewer, ViewerConfig
from scans import messages
viewer = Viewer(ViewerConfig(show="connect", url=sys.argv[1]))
viewer.open()
os.kill(int(sys.argv[2]), signal.SIGSTOP)
for message in messages(120, 60.0, (600, 960)):
    list(viewer.step(message))
assert viewer.trouble()
viewer.close()
"""


def test_the_process_ends_beside_a_stalled_viewer(rerun_server: ViewerProcess) -> None:
    command = [sys.executable, "-c", ENDS_BESIDE_A_STALLED_VIEWER, rerun_server.url, str(rerun_server.pid)]
    environment = {**os.environ, "PYTHONPATH": str(Path(scans.__file__).parent)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr


def test_a_killed_viewer_is_survived_and_its_page_comes_back() -> None:
    viewer = Viewer(ViewerConfig(show="web", port=0, web_port=0))
    viewer.open()
    assert viewer.process is not None
    feed(viewer, 0.5, 0.0)
    first = viewer.process.pid
    os.kill(first, signal.SIGKILL)
    deadline = time.monotonic() + 90
    start_s = 1.0
    while (viewer.process.pid == first or viewer.trouble()) and time.monotonic() < deadline:
        assert feed(viewer, 0.5, start_s) < HELD_UP_S
        start_s += 1.0
    assert viewer.process.pid != first
    assert viewer.trouble() == ""
    viewer.close()
    assert not viewer.process.alive()


def test_a_closed_window_stays_closed_and_is_no_trouble() -> None:
    window = ViewerProcess(arguments=("--serve-grpc",))  # stands for a window: no page of its own
    sink = ViewerSink(window.url, scan_blueprint(), window.revive)
    window.stop()
    frames = (message for message in messages(200, 20.0) if isinstance(message, m.Frame))
    for frame in frames:
        for entry in entries.frame(frame):
            sink.log(frame.stamp_ns, entry)
    assert not window.alive()
    assert sink.trouble == ""
    assert 0 < sink.lost < 100
    sink.close()


def test_the_web_viewer_listens_on_loopback_only(rerun_server: ViewerProcess) -> None:
    import psutil

    listening = {c.laddr.ip for c in psutil.Process(rerun_server.pid).net_connections() if c.status == "LISTEN"}
    assert listening == {"127.0.0.1"}


def test_a_busy_port_is_one_line_that_says_what_to_do() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(UserError, match=r"port \d+ is busy; give"):
            free_port(taken.getsockname()[1])


def test_no_more_than_thirty_hertz() -> None:
    with pytest.raises(ValueError, match="less than or equal to 30"):
        ViewerConfig(rate_hz=60)
