"""``endo3d export`` and ``endo3d view`` as a user runs them."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import numpy as np
import psutil
import pytest
from plyfile import PlyData
from rosbags.highlevel import AnyReader


def endo3d(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "endo3d.services.cli.app", *map(str, arguments)]
    environment = {name: value for name, value in os.environ.items() if "DISPLAY" not in name}
    return subprocess.run(command, capture_output=True, text=True, timeout=240, env=environment, check=False)


def test_export_writes_everything_that_is_named(log: Path, tmp_path: Path) -> None:
    done = endo3d(
        "export", log, tmp_path / "new" / "map.ply", tmp_path / "way.csv", tmp_path / "way.tum",
        "--clouds", tmp_path / "clouds", "--clouds-as", "pcd",
        "--depth", tmp_path / "depth", "--depth-as", "tiff", "--ros2", tmp_path / "bag",
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    vertex = PlyData.read(str(tmp_path / "new" / "map.ply"))["vertex"]
    assert f"map.ply: {len(vertex)} points" in done.stdout
    assert {"red", "green", "blue", "sigma", "nx"} <= {prop.name for prop in vertex.properties}
    assert len((tmp_path / "way.csv").read_text().splitlines()) == 1 + 4
    assert len(np.loadtxt(tmp_path / "way.tum")) == 4
    assert len(list((tmp_path / "clouds").glob("*.pcd"))) == 4
    assert len(list((tmp_path / "depth").glob("*.tiff"))) == 4
    with AnyReader([tmp_path / "bag"]) as bag:
        assert bag.message_count == 6 * 4 + 1


@pytest.mark.parametrize(
    ("arguments", "advice"),
    [
        (["export", "LOG"], "nothing to export: name a file"),
        (["export", "LOG", "map.las"], "no format '.las'; a file ends in one of .csv"),
        (["export", "missing.mcap", "map.ply"], "can't read missing.mcap"),
        (["export", "LOG", "--depth", "FOLDER", "--depth-as", "exr"], "no depth format 'exr'; choose png"),
        (["export", "LOG", "--ros2", "FOLDER"], "exists; a bag is a new folder"),
        (["view", "LOG"], "no display here: endo3d view LOG --web"),
        (["view", "LOG", "--colour", "pink"], "no colouring 'pink'; choose height"),
        (["view", "missing.mcap"], "can't read missing.mcap"),
    ],
)
def test_what_can_not_be_done_is_one_line(log: Path, tmp_path: Path, arguments: list[str], advice: str) -> None:
    names = {"LOG": str(log), "FOLDER": str(tmp_path)}
    done = endo3d(*(names.get(argument, argument) for argument in arguments))
    assert done.returncode == 2
    assert advice in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_view_makes_picture_and_recording_without_a_screen(log: Path, tmp_path: Path) -> None:
    done = endo3d("view", log, "--picture", tmp_path / "scan.png", "--rrd", tmp_path / "scan.rrd")
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "scan.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "scan.rrd").read_bytes().startswith(b"RRF2")


def test_view_serves_a_page_and_ends_with_all_it_started(log: Path) -> None:
    command = [sys.executable, "-m", "endo3d.services.cli.app", "view", str(log), "--web"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as view:
        assert view.stdout is not None
        page = re.search(r"open (\S+)", view.stdout.readline())
        assert page is not None
        with urllib.request.urlopen(page[1], timeout=90) as reply:
            assert b"rerun" in reply.read().lower()
        started = psutil.Process(view.pid).children()
        assert [process.name() for process in started] == ["rerun"]
        view.send_signal(signal.SIGINT)
        assert view.wait(timeout=90) == 0
    assert not any(process.is_running() for process in started)
