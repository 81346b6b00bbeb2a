"""The whole stack at the paper's hand-guided rate: 26 s of prerendered 1920 x 1200 frames at 172 Hz.

A log plays the camera; decoder, odometry, recorder and viewer run as processes, and this one listens to the
clouds. Goals: no lost frame; frame to cloud p99 within 3 frame periods beyond the decoder's own window. The
frames (10 GB) are rendered once, into build/bench, and read once before the run: a camera is no disk either.

    python -m bench.stack [--seconds 26]
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import psutil

from endo3d.schemas import topics
from endo3d.services.archive.reader import Log
from endo3d.services.cli.demo import scan

SCENE = "contour texture=noise:0.15:0.15"
RATE_HZ, SECONDS = 172.0, 26.0
GOAL_MS = 3 * 1e3 / RATE_HZ
FRAMES = Path("build/bench/contour-172hz.mcap")
SERVICES = ("player", "decoder", "odometry", "recorder", "viewer")


def prerendered() -> Path:
    """The log that plays the camera, rendered if it isn't there."""
    if not FRAMES.exists():
        FRAMES.parent.mkdir(parents=True, exist_ok=True)
        endo3d = [sys.executable, "-m", "endo3d.services.cli.app", "render", SCENE, "-o", str(FRAMES)]
        subprocess.run([*endo3d, "--preset", "fast", "--rate", str(RATE_HZ), "--seconds", str(SECONDS)], check=True)
    return FRAMES


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seconds", type=float, default=SECONDS, help="how much of the log is played")
    end_s = parser.parse_args().seconds
    frames = prerendered()
    log = Log(frames)
    end_ns = log.start_ns + round(end_s * 1e9)
    rendered = sum(1 for _ in log.records((topics.FRAME,), end_ns=end_ns))  # with every page into memory
    with tempfile.TemporaryDirectory(dir=frames.parent) as folder:
        settings = [f"rig.name=stack{os.getpid()}", f"player.log={frames.resolve()}", "viewer.port=0"]
        settings += [f"player.end_s={end_s}", f"recorder.directory={folder}", "recorder.name=scan", "viewer.web_port=0"]
        before = psutil.cpu_times()
        run = scan("player", settings, seconds=10 * SECONDS, quiet=True)
        after = psutil.cpu_times()
        recorded = Log(Path(folder) / "scan.mcap")
        counts = {topic.name: recorded.count(topic) for topic in (topics.FRAME, topics.POSE)}
    print(f"first cloud {run['start_s']:.1f} s after the command, then {run['scan_s']:.1f} s at {RATE_HZ:g} Hz")
    print(f"frames rendered {rendered}, recorded {counts['frame']}")
    print(f"clouds received {run['clouds']}, poses recorded {counts['pose']}")
    for name in SERVICES:
        lost = run["lost"].get(name, {})
        said = ", ".join(f"{cause} {count}" for cause, count in lost.items()) or "nothing"
        print(f"lost in {name:<10} {said}")
    cloud, pose = run["latency_cloud_ms"], run["latency_pose_ms"]
    print(f"newest frame to cloud  p50 {cloud['p50']:.1f} ms, p99 {cloud['p99']:.1f} ms (goal {GOAL_MS:.1f} ms)")
    print(f"newest frame to pose   p50 {pose['p50']:.1f} ms, p99 {pose['p99']:.1f} ms")
    seconds = run["start_s"] + run["scan_s"]
    idle = after.idle - before.idle + after.iowait - before.iowait
    print(f"machine    {os.cpu_count()} cores, {idle / seconds:.2f} of them idle, "
          f"{(after.steal - before.steal) / seconds:.2f} taken by the host, start included")  # fmt: skip
    for name, status in run["services"].items():
        print(f"{name:<10} {status['cpu_percent']:5.0f} % of a core, {status['memory_mb']:6.0f} MB")


if __name__ == "__main__":
    main()
