"""The command line against a running stack, and the demo from the command to its files."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import psutil
import pytest
import trimesh

from endo3d.schemas import topics
from endo3d.services.archive.reader import Log

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

ENDO3D = [sys.executable, "-m", "endo3d.services.cli.app"]
SERVICES = {"sequencer", "grabber", "decoder", "odometry", "recorder", "viewer"}
SLOWLY = "grabber.camera=sim:contour texture=noise:0.15:0.15?motion=hand seed=7&bin=2&slow_motion=28.7"
"""A rate that a busy machine holds too, and the slow motion that belongs to it."""
START_LIMIT_S = 240.0
"""The first start on a machine compiles every kernel."""


def endo3d(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*ENDO3D, *arguments], capture_output=True, text=True, timeout=START_LIMIT_S)


def top(rig: str) -> dict[str, dict[str, Any]]:
    """service -> how it does now."""
    return {row["service"]: row for row in json.loads(endo3d("top", "--once", "--json", "--rig", rig).stdout)}


def settings(rig: str, folder: Path) -> list[str]:
    pairs = (f"rig.name={rig}", f"recorder.directory={folder}", "recorder.name=scan", "viewer.show=none")
    return [part for pair in pairs for part in ("--set", pair)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("up")


@pytest.fixture(scope="module")
def rig() -> str:
    return f"up{os.getpid()}"


@pytest.fixture(scope="module")
def up(rig: str, folder: Path) -> Iterator[subprocess.Popen[str]]:
    """``endo3d up demo``, once clouds come."""
    with subprocess.Popen(
        [*ENDO3D, "up", "demo", *settings(rig, folder), "--set", "sequencer.rate_hz=6", "--set", SLOWLY],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        try:
            first = endo3d("tap", "pose", "--rig", rig, "-n", "1", "--timeout", str(START_LIMIT_S / 2))
            assert first.returncode == 0, first.stderr
            yield process
        finally:
            process.kill()


@pytest.mark.usefixtures("up")
class TestAgainstARunningStack:
    def test_top_shows_every_service(self, rig: str) -> None:
        end_s = time.monotonic() + START_LIMIT_S
        rows = top(rig)
        # The viewer yields, also while it starts; a busy machine may have no cloud in one second.
        while not (set(rows) == SERVICES and rows["decoder"]["rate_hz"] > 0.0):
            assert time.monotonic() < end_s, rows
            rows = top(rig)
        assert all(row["alive"] for row in rows.values())
        assert rows["decoder"]["latency_p50_ms"] > 0.0
        assert "decoder" in endo3d("top", "--once", "--rig", rig).stdout

    def test_tap_prints_and_saves(self, rig: str, tmp_path: Path) -> None:
        pose = json.loads(endo3d("tap", "pose", "--rig", rig, "-n", "1", "--json").stdout)
        assert len(pose["T_world_camera"]) == 4
        assert endo3d("tap", f"endo3d/{rig}/frame", "-n", "2", "--save", str(tmp_path)).returncode == 0
        assert endo3d("tap", "cloud", "--rig", rig, "-n", "1", "--save", str(tmp_path)).returncode == 0
        images = [cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in tmp_path.glob("frame_*.png")]
        assert [image.shape for image in images if image is not None] == [(600, 960)] * 2
        (cloud,) = tmp_path.glob("cloud_*.ply")
        assert len(trimesh.load(cloud).vertices) > 1000

    def test_mode_switches_and_refuses(self, rig: str) -> None:
        reply = json.loads(endo3d("mode", "conventional", "--rig", rig, "--json").stdout)
        assert reply["pattern_set"].startswith("conventional")
        shown = json.loads(endo3d("tap", "mode", "--rig", rig, "-n", "1", "--json").stdout)
        assert (shown["mode"], shown["epoch"]) == ("conventional", reply["epoch"])
        refused = endo3d("mode", "nonsense", "--rig", rig)
        assert refused.returncode == 2
        assert refused.stderr.startswith("endo3d: sequencer refuses mode: 'nonsense' is no mode")
        assert endo3d("mode", "interleaved", "--rig", rig).returncode == 0

    def test_recording_stops_and_starts(self, rig: str, folder: Path) -> None:
        stopped = json.loads(endo3d("record", "stop", "--rig", rig, "--json").stdout)
        assert Log(stopped["files"][0]).count(topics.FRAME) > 0
        assert endo3d("record", "stop", "--rig", rig).stderr.startswith("endo3d: recorder refuses stop: not recording")
        started = json.loads(endo3d("record", "start", "--name", "second", "--rig", rig, "--json").stdout)
        assert Path(started["recording"]) == folder / "second.mcap"

    def test_sigterm_closes_the_archive_and_leaves_nothing(
        self, up: subprocess.Popen[str], rig: str, folder: Path
    ) -> None:
        """Runs last."""
        children = psutil.Process(up.pid).children(recursive=True)
        assert len(children) >= 6
        assert endo3d("tap", "pose", "--rig", rig, "-n", "5", "--timeout", "90").returncode == 0
        up.send_signal(signal.SIGTERM)
        said = up.communicate(timeout=180)[0]
        assert up.returncode == 0, said
        assert "recorder  │ INFO recorded" in said
        assert not any(child.is_running() for child in children)
        assert Log(folder / "second.mcap").count(topics.POSE) > 0


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, object]]:
    """A demo of eight seconds, its folder and its figures."""
    folder = tmp_path_factory.mktemp("demo")
    ended = endo3d("demo", "--seconds", "8", "--json", "--out", str(folder), *settings(f"demo{os.getpid()}", folder))
    assert ended.returncode == 0, ended.stderr
    return folder, json.loads(ended.stdout)


class TestDemo:
    def test_figures(self, demo: tuple[Path, dict[str, object]]) -> None:
        folder, report = demo
        assert json.loads((folder / "report.json").read_text()) == report
        assert report["simulated"] is True
        for key in ("frames", "rate_hz", "map_points", "poses", "way_mm"):
            assert float(report[key]) > 0, key  # type: ignore[arg-type]

    def test_files(self, demo: tuple[Path, dict[str, object]]) -> None:
        folder, report = demo
        log = Log(folder / "scan.mcap")
        assert log.count(topics.FRAME) == report["frames"]
        cloud = trimesh.load(folder / "map.ply")
        assert len(cloud.vertices) == report["map_points"]
        picture = cv2.imread(str(folder / "picture.png"))
        assert picture is not None
        assert picture.std() > 5.0, "something is to be seen"
        assert (folder / "scan.rrd").read_bytes()[:3] == b"RRF"

    def test_the_map_is_right_against_the_truth(self, demo: tuple[Path, dict[str, object]]) -> None:
        truth = demo[1]["against_truth"]
        assert isinstance(truth, dict)
        assert truth["trajectory"]["rms_um"] < 200.0
        assert truth["surface"]["p95_um"] < 100.0


def test_ctrl_c_ends_a_demo_early_with_its_table(tmp_path: Path) -> None:
    rig = f"early{os.getpid()}"
    arguments = ["demo", "--seconds", "600", "--out", str(tmp_path), *settings(rig, tmp_path)]
    with subprocess.Popen([*ENDO3D, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert endo3d("tap", "pose", "--rig", rig, "-n", "30", "--timeout", str(START_LIMIT_S / 2)).returncode == 0
            began_s = time.monotonic()
            process.send_signal(signal.SIGINT)
            said, errors = process.communicate(timeout=240)
        finally:
            process.kill()
    assert process.returncode == 0, errors
    assert "trajectory error" in said
    assert time.monotonic() - began_s < 240.0  # of the 600 s it was to last
