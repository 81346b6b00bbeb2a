"""The disk may be slow, full or broken: the pipeline goes on, drops are counted, the file stays whole."""

from __future__ import annotations

import errno
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from mcap.reader import make_reader

from endo3d.services.archive.entry import Attachment, Entry
from endo3d.services.archive.layout import Buffer
from endo3d.services.archive.reader import Log
from endo3d.services.archive.recording import Recording
from endo3d.services.archive.recover import recover
from endo3d.services.archive.scan import FoundChunk, walk
from endo3d.services.archive.sink import FileSink, Sink
from endo3d.services.archive.spool import Spool
from endo3d.services.archive.writer import Kind

IMAGE = Entry("/image", Kind("an.Image", "protobuf", b""), 0, 0, 0, ())
POSE = Entry("/pose", Kind("a.Pose", "protobuf", b""), 0, 0, 0, ())
SIZE = 100_000


class GatedSink(FileSink):
    """A disk that takes nothing while its gate is shut."""

    gate: threading.Event

    def write(self, *parts: Buffer) -> None:
        self.gate.wait()
        super().write(*parts)


class SmallSink(FileSink):
    """A disk with room for so many bytes; when it was full once, there is room for the end, unless it is broken."""

    room = 10 * SIZE
    broken = False
    full = False

    def write(self, *parts: Buffer) -> None:
        size = sum(map(len, parts))
        was_full, self.full = self.full, self.full or self.room < size
        if self.full and (self.broken or not was_full):
            super().write(bytes(parts[0])[: self.room])
            raise OSError(errno.ENOSPC, "No space left on device")
        self.room -= size
        super().write(*parts)


def fill(sequence: int, memory: memoryview) -> None:
    memory[:] = bytes([sequence % 256]) * len(memory)


def offer(spool: Spool, entry: Entry, sequence: int, size: int) -> bool:
    return spool.put(replace(entry, sequence=sequence, log_ns=sequence), size, partial(fill, sequence))


def sequences(path: Path) -> list[int]:
    with path.open("rb") as file:
        found = []
        for _, _, message in make_reader(file, validate_crcs=True).iter_messages():
            assert message.data == bytes([message.sequence % 256]) * len(message.data)
            found.append(message.sequence)
        return found


def recording(path: Path, open_sink: Callable[[Path], Sink] = FileSink) -> Recording:
    return Recording(path, {"fact": "1"}, open_sink=open_sink)


def test_a_slow_disk_drops_and_counts_and_never_blocks(tmp_path: Path) -> None:
    GatedSink.gate = threading.Event()
    path = tmp_path / "slow.mcap"
    spool = Spool(recording(path, GatedSink), queue_bytes=20 * (1 << 17))
    slowest_s, taken = 0.0, []
    for sequence in range(200):
        before = time.perf_counter()
        if offer(spool, IMAGE, sequence, SIZE):
            taken.append(sequence)
        slowest_s = max(slowest_s, time.perf_counter() - before)
    assert slowest_s < 20.0  # the disk stands still all the while: it would be for ever
    assert taken == list(range(20))
    assert spool.dropped == {"/image": 180}
    GatedSink.gate.set()
    spool.close()
    assert sequences(path) == taken
    assert spool.trouble == ""


def test_room_returns_when_the_disk_recovers(tmp_path: Path) -> None:
    GatedSink.gate = threading.Event()
    path = tmp_path / "hiccup.mcap"
    spool = Spool(recording(path, GatedSink), queue_bytes=4 * (1 << 17))
    while offer(spool, IMAGE, 1, SIZE):
        pass
    GatedSink.gate.set()
    deadline = time.monotonic() + 90
    while not offer(spool, IMAGE, 2, SIZE):
        assert time.monotonic() < deadline
    spool.close()
    assert sequences(path)[-1] == 2


def test_a_full_disk_leaves_a_whole_file_and_says_so(tmp_path: Path) -> None:
    path = tmp_path / "full.mcap"
    SmallSink.broken = False
    spool = Spool(recording(path, SmallSink), queue_bytes=100 << 20)
    for sequence in range(50):
        offer(spool, IMAGE, sequence, SIZE)
        offer(spool, POSE, sequence, 10)
    spool.close()
    kept = sequences(path)
    assert kept == sorted(set(kept))
    assert 0 < len(kept) <= 10
    assert "No space left" in spool.trouble
    assert spool.dropped["/image"] == 50 - len(kept)


def test_a_disk_that_takes_not_even_the_end_says_how_to_recover(tmp_path: Path) -> None:
    path = tmp_path / "broken.mcap"
    SmallSink.broken = True
    spool = Spool(recording(path, SmallSink), queue_bytes=100 << 20)
    for sequence in range(50):
        offer(spool, IMAGE, sequence, SIZE)
    spool.close()
    assert f"endo3d recover {path}" in spool.trouble
    report = recover(path)
    assert sequences(path) == list(range(report.messages))
    assert report.messages + spool.dropped["/image"] == 50


def test_the_watermark_stops_before_the_disk_is_full(tmp_path: Path) -> None:
    path = tmp_path / "low.mcap"
    spool = Spool(recording(path), queue_bytes=1 << 20, floor_bytes=1 << 62)
    offer(spool, IMAGE, 0, SIZE)
    spool.close()
    assert sequences(path) == [0]
    assert "left on the disk" in spool.trouble
    assert not offer(spool, IMAGE, 1, SIZE)
    assert spool.dropped == {"/image": 1}


def test_what_was_overwritten_while_copied_is_a_drop(tmp_path: Path) -> None:
    path = tmp_path / "invalid.mcap"
    spool = Spool(recording(path), queue_bytes=1 << 20)
    assert not spool.put(IMAGE, SIZE, partial(fill, 1), valid=lambda: False)
    assert spool.put(IMAGE, SIZE, partial(fill, 0))
    spool.close()
    assert sequences(path) == [0]
    assert spool.dropped == {"/image": 1}


def test_a_failing_packer_ends_the_recording_not_the_thread(tmp_path: Path) -> None:
    def fail(entry: Entry) -> Entry:
        if entry.sequence == 3:
            raise RuntimeError("no codec")
        return entry

    path = tmp_path / "fail.mcap"
    spool = Spool(recording(path), queue_bytes=10 << 20, transform=fail)
    for sequence in range(6):
        offer(spool, IMAGE, sequence, SIZE)
    spool.close()
    assert "no codec" in spool.trouble
    assert sequences(path) == [0, 1, 2]


def test_small_messages_reach_the_disk_without_more_to_follow(tmp_path: Path) -> None:
    """A kill right after would find them: the file, unfinished, holds them in a whole chunk."""
    flushed = threading.Event()

    class WatchedSink(FileSink):
        def write(self, *parts: Buffer) -> None:
            super().write(*parts)
            if any(b"pose!" in bytes(part) for part in parts):
                flushed.set()

    path = tmp_path / "live.mcap"
    spool = Spool(recording(path, WatchedSink), queue_bytes=1 << 20)
    spool.put(POSE, 5, lambda memory: memory.__setitem__(slice(None), b"pose!"))
    assert flushed.wait(90)
    chunks = [item for item in walk(memoryview(path.read_bytes())) if isinstance(item, FoundChunk)]
    assert len(chunks) == 1
    spool.close()


@pytest.mark.parametrize("split", [{"split_bytes": 5 * SIZE}, {"split_s": 4e-9}])
def test_every_part_stands_alone(tmp_path: Path, split: dict[str, float]) -> None:
    files = [Attachment("stack.toml", "application/toml", b"[rig]\n")]
    made = Recording(tmp_path / "scan.mcap", {"fact": "1"}, files, **split)
    calibration = Attachment("calibration.yaml", "application/yaml", b"K: 1\n")
    latched = replace(POSE, channel="/mode", payload=(b"mode",), latched=True, attachment=calibration)
    made.put(latched)
    for sequence in range(12):
        made.put(replace(IMAGE, sequence=sequence, log_ns=sequence, payload=(bytes(SIZE),)))
    made.finish()
    assert len(made.parts) >= 3
    assert [part.name for part in made.parts] == [f"scan_{i:03d}.mcap" for i in range(len(made.parts))]
    images = []
    for number, part in enumerate(made.parts):
        log = Log(part)
        assert log.attachments == {"stack.toml": b"[rig]\n", "calibration.yaml": b"K: 1\n"}
        assert log.facts["endo3d"] == {"fact": "1", "part": str(number)}
        assert [bytes(r.payload) for r in log.records() if r.stream.name == "/mode"] == [b"mode"]
        images += [record.sequence for record in log.records() if record.stream.name == "/image"]
    assert images == list(range(12))
    assert made.messages == 13
    assert made.size == sum(part.stat().st_size for part in made.parts)


def test_an_existing_log_is_never_overwritten(tmp_path: Path) -> None:
    for expected in ("log.mcap", "log-2.mcap", "log-3.mcap"):
        made = recording(tmp_path / "log.mcap")
        made.put(replace(POSE, payload=(b"x",)))
        made.finish()
        assert made.parts == [tmp_path / expected]
