"""The viewer beside a camera at full rate: what it costs, and what a stalled Rerun costs the writer.

1920x1200 at 180 Hz with clouds and depth maps of 4x4 bins and poses, into a viewer process that serves a page.
Images are noise, the worst case for their encoder. In the second half Rerun is stopped (SIGSTOP).
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import psutil

from endo3d.schemas import messages as m
from endo3d.schemas import topics
from endo3d.services.runtime.bus import Bus

HZ = 180.0
PHASE_S = 8.0
SHAPE, GRID = (1200, 1920), (300, 480)
VIEWER = """
import sys
from endo3d.services.runtime import runner
from endo3d.services.viewer import Viewer, ViewerConfig
sys.exit(runner.run(Viewer(ViewerConfig(show="web", port=0, web_port=0)), rig=sys.argv[1], name="viewer"))
"""


def main() -> None:
    rig = f"viewer{os.getpid()}"
    there = threading.Event()
    taken: dict[str, int] = {}

    def note(message: m.Message) -> None:
        if isinstance(message, m.Status):
            taken.update(message.dropped)

    with (
        Bus.open(rig, name="bench") as bus,
        subprocess.Popen([sys.executable, "-c", VIEWER, rig], stderr=subprocess.DEVNULL) as child,
    ):
        bus.subscribe(topics.STATUS, note)
        bus.watch_alive(lambda name, is_there: there.set() if name == "viewer" else None)
        if not there.wait(60):
            raise SystemExit("the viewer did not start")
        viewer = psutil.Process(child.pid)
        (rerun,) = viewer.children()
        publish(bus, 2.0)  # first mappings, first images
        print(f"1920x1200 at {HZ:.0f} Hz, clouds and depth maps of {GRID[1]}x{GRID[0]}, {PHASE_S:.0f} s each")
        print(f"{'':16}{'rate Hz':>9}{'viewer %':>10}{'rerun %':>9}{'publish p50 ms':>16}{'max ms':>8}")
        for name in ("Rerun takes it", "Rerun stopped"):
            if name == "Rerun stopped":
                os.kill(rerun.pid, signal.SIGSTOP)
            before, start = (busy_s(viewer), busy_s(rerun)), time.monotonic()
            took_ms = publish(bus, PHASE_S)
            lasted_s = time.monotonic() - start
            shares = [100 * (busy_s(p) - b) / lasted_s for p, b in zip((viewer, rerun), before, strict=True)]
            rate_hz = len(took_ms) / lasted_s
            print(
                f"{name:16}{rate_hz:9.1f}{shares[0]:10.0f}{shares[1]:9.0f}"
                f"{np.median(took_ms):16.2f}{took_ms.max():8.1f}"
            )
        child.send_signal(signal.SIGTERM)
        child.wait(20)
        lost = {cause: count for cause, count in bus.tally.dropped.items() if count}
    print(f"writer's losses: {lost or 'none'}; entries a stopped Rerun missed: {taken.get('view:not taken', 0)}")


def publish(bus: Bus, seconds: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Milliseconds that each frame and what goes with it took to publish, paced."""
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, SHAPE, np.uint8)
    v, u = np.mgrid[: GRID[0], : GRID[1]].astype(np.float32)
    points = np.zeros(GRID, m.POINT)
    points["x"], points["y"], points["z"] = (u - 240) / 25, (v - 150) / 25, 20 + np.sin(u / 30)
    depth = np.round(1e3 * points["z"]).astype(np.uint16)
    took_ms = []
    start = time.monotonic()
    for k in range(round(HZ * seconds)):
        time.sleep(max(0.0, start + k / HZ - time.monotonic()))
        before = time.perf_counter()
        now = time.time_ns()
        shared = bus.loan(topics.FRAME, SHAPE, np.uint8)
        shared[:] = image
        bus.publish(m.Frame(now, k, shared, "interleaved f1=25", k % 6, 1, 2900.0, now, k))
        bus.publish(m.Cloud(now, k, points, 3, now, 1, "interleaved f1=25", 4.0, points.size))
        bus.publish(m.DepthMap(now, k, depth, 1e-3, 0.0, 4.0))
        T = np.eye(4)
        T[0, 3] = 0.01 * k
        bus.publish(m.Pose(now, k, T, np.eye(6), m.Tracking.TRACKING, 4.0, np.eye(6)[0], 0.9, 6.0, 0.3, 0, now))
        took_ms.append(1e3 * (time.perf_counter() - before))
    return np.array(took_ms)


def busy_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return times.user + times.system


if __name__ == "__main__":
    main()
