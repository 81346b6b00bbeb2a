"""The faults themselves: a recorder killed -9 at any moment, a file system that fills up."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import pytest
from mcap.reader import make_reader
from recorded import YAML, frame, pose, same, sample

from endo3d.schemas import topics
from endo3d.services.archive.reader import Log, Unreadable
from endo3d.services.archive.recover import is_whole, recover
from endo3d.services.archive.spool import FLUSH_S
from endo3d.services.recorder import Recorder, RecorderConfig

HERE = Path(__file__).parent
KILLS = 6


def test_killed_at_any_moment_a_log_loses_its_last_chunk_at_most(tmp_path: Path) -> None:
    moments = random.Random(3)
    for kill in range(KILLS):
        directory = tmp_path / str(kill)
        taken_ns, in_file, killed_ns = _record_and_kill(directory, moments.uniform(0.1, 1.2))
        log = directory / "scan.mcap"
        assert not is_whole(log)
        with pytest.raises(Unreadable, match="endo3d recover"):
            Log(log)
        recover(log)
        recovered = Log(log)
        assert recovered.attachments["calibration.yaml"] == YAML.encode()
        frames = list(recovered.messages(topics.FRAME))
        poses = list(recovered.messages(topics.POSE))
        assert _first_missing(frames) >= in_file
        oldest_lost = _first_missing(poses)
        if oldest_lost < len(taken_ns):
            held_up_ns = max(later - earlier for earlier, later in pairwise((*taken_ns, killed_ns)))
            assert (killed_ns - taken_ns[oldest_lost] - 3 * held_up_ns) * 1e-9 < FLUSH_S + 0.3
        assert all(same(item, frame(item.sequence)) for item in frames)
        assert all(same(item, pose(item.sequence)) for item in poses)
        _read_by_the_library(log)


def _record_and_kill(directory: Path, after_s: float) -> tuple[list[int], int, int]:
    """When each message was taken, how many frames were in the file, when the kill came; monotonic ns."""
    command = [sys.executable, str(HERE / "recorder_process.py"), str(directory)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=HERE) as process:
        assert process.stdout is not None
        first = process.stdout.readline()
        time.sleep(after_s)  # the moment of the kill: this IS what is tested
        process.send_signal(signal.SIGKILL)
        killed_ns = time.monotonic_ns()
        lines = [first, *process.stdout.readlines()]
    taken, in_file = zip(*(map(int, line.split()) for line in lines if line.endswith("\n")), strict=True)
    return list(taken), in_file[-1], killed_ns


def _first_missing(messages: list) -> int:
    sequences = {message.sequence for message in messages}
    return next(number for number in range(len(sequences) + 1) if number not in sequences)


def _read_by_the_library(path: Path) -> None:
    with path.open("rb") as file:
        assert sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages()) > 0


def test_a_restarted_recorder_repairs_what_its_forerunner_left(tmp_path: Path) -> None:
    _record_and_kill(tmp_path, 0.3)
    recorder = Recorder(RecorderConfig(directory=tmp_path, name="scan", floor_mb=0, reserve_mb=0))
    recorder.open()
    list(recorder.take(sample(frame(0))))
    recorder.close()
    logs = sorted(tmp_path.glob("*.mcap"))
    assert [log.name for log in logs] == ["scan-2.mcap", "scan.mcap"]
    assert all(Log(log).count(topics.FRAME) > 0 for log in logs)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 16 MB, mounted for this test."""
    path = tmp_path / "disk"
    path.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=16m", "endo3d-test", str(path)]
    tried = subprocess.run(mount, capture_output=True, text=True, check=False)
    if tried.returncode:
        pytest.skip(f"needs permission to mount: {tried.stderr.strip()}")
    yield path
    # Lazily: a failed test still holds views of its log.
    subprocess.run(["umount", "--lazy", str(path)], check=True)


@pytest.mark.parametrize(("floor_mb", "reserve_mb"), [(4, 0), (0, 1)])
def test_a_disk_that_fills_up(small_disk: Path, floor_mb: int, reserve_mb: int) -> None:
    """With a watermark recording stops before; without one, the reserve makes room for the index."""
    config = RecorderConfig(directory=small_disk, name="scan", floor_mb=floor_mb, reserve_mb=reserve_mb)
    recorder = Recorder(config)
    recorder.open()
    for sequence in range(400):
        list(recorder.take(sample(frame(sequence))))
    recorder.close()
    log = Log(small_disk / "scan.mcap")
    frames = [message.sequence for message in log.messages(topics.FRAME)]
    assert frames == list(range(len(frames)))
    assert len(frames) > 100
    assert recorder.losses() == {"frame:disk": 400 - len(frames)}
    if floor_mb:
        assert 3 << 20 < _free(small_disk) < 4 << 20
    _read_by_the_library(log.path)


def test_a_disk_filled_by_somebody_else(small_disk: Path) -> None:
    config = RecorderConfig(directory=small_disk, name="scan", floor_mb=0, reserve_mb=1)
    recorder = Recorder(config)
    recorder.open()
    list(recorder.take(sample(frame(0))))
    _wait_until(lambda: recorder.values()["messages"] == 1)
    _fill(small_disk / "other")
    for sequence in range(1, 50):
        list(recorder.take(sample(frame(sequence))))
    recorder.close()
    kept = Log(small_disk / "scan.mcap").count(topics.FRAME)
    assert kept >= 1
    assert recorder.losses() == {"frame:disk": 50 - kept}


def test_a_disk_that_is_full_from_the_start(small_disk: Path) -> None:
    """No file is left that isn't a log, and the pipeline goes on."""
    recorder = Recorder(RecorderConfig(directory=small_disk, name="scan", floor_mb=0, reserve_mb=0))
    recorder.open()
    _fill(small_disk / "other")
    for sequence in range(5):
        list(recorder.take(sample(frame(sequence))))
    _wait_until(lambda: recorder.losses() == {"frame:disk": 5})
    assert "No space left" in recorder.trouble()
    recorder.close()
    assert list(small_disk.iterdir()) == [small_disk / "other"]


def _wait_until(true: Callable[[], bool]) -> None:
    """For what another thread does without telling."""
    deadline = time.monotonic() + 90
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.001)


def _fill(path: Path) -> None:
    with path.open("wb", buffering=0) as file:
        os.posix_fallocate(file.fileno(), 0, _free(path.parent))
    assert _free(path.parent) == 0


def _free(directory: Path) -> int:
    state = os.statvfs(directory)
    return state.f_bavail * state.f_frsize
