"""Writing and reading logs of 1920x1200 frames, beside what else could write them, in the same run.

    python -m bench.archive [SECONDS]

Frames are rendered by the virtual rig with all effects: the packing ratio depends on their (simulated) noise.
"Paced" is 180 Hz for SECONDS (60 unless told; cropped: half) through the recorder's own step, as the bus calls
it. Files go to the system's directory for temporary files, up to 25 GB at a time. Goals: paced 0 drops, <= 40 %
of a core raw, <= 60 % compact; >= 2 GB/s into a null sink; reading >= 1 GB/s; the poses of a 10 GB log in < 0.1 s;
decoding a log >= 5 x real time.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import foxglove
import numpy as np
from foxglove.mcap import MCAPWriteOptions
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as LibraryWriter

from endo3d.schemas import codec, topics
from endo3d.schemas import messages as m
from endo3d.schemas.topics import Topic
from endo3d.services.archive.compact import Packer
from endo3d.services.archive.reader import Log
from endo3d.services.archive.sink import file_sink
from endo3d.services.archive.writer import Kind, Writer
from endo3d.services.recorder import Recorder, RecorderConfig
from endo3d.services.runtime import replay as engine
from endo3d.services.runtime import stack_file
from endo3d.services.runtime.service import Sample
from endo3d_core import patterns
from endo3d_core.calibration import Rig
from endo3d_core.head import Head
from endo3d_core.virtual_rig import motion, scene
from endo3d_core.virtual_rig.effects import PRESETS
from endo3d_core.virtual_rig.renderer import Renderer

RATE_HZ = 180.0
EXPOSURE_US = 5200.0
REPEATS = 3
"""Periods of the pattern set that are rendered."""
BURST = 400
"""Frames written as fast as possible: 0.9 GB."""
START_NS = 1_790_000_000_000_000_000
POSE = memoryview(
    codec.encode(m.Pose(0, 0, np.eye(4), np.eye(6), m.Tracking.TRACKING, 1.0, np.zeros(6), 1.0, 1.0, 0.0))
)
FRAME_KIND = Kind(*codec.schema(topics.FRAME))
HEAD = stack_file.stock("heads")["base6_wd20"]


class Scan:
    """Frames as they travel on the bus: the images repeat, sequence numbers and stamps go on."""

    def __init__(self) -> None:
        yaml = HEAD.read_text(encoding="utf-8")
        rig, pattern_set = Rig.from_yaml(yaml), patterns.parse("interleaved f1=15")
        body = scene.parse("contour texture=noise:0.15")
        renderer = Renderer(rig, Head.from_yaml(yaml), body, PRESETS["full"])
        window, path = rig.projector, motion.parse("hand seed=7").T_scene_camera
        self._frames, self._samples = [], []
        for k in range(REPEATS * len(pattern_set)):
            image = np.zeros((rig.camera.height, rig.camera.width), np.uint8)
            slot = k % len(pattern_set)
            light = renderer.light(patterns.image(pattern_set[slot], window.width, window.height))
            poses = renderer.poses(path, k / 172, EXPOSURE_US)
            renderer.frame(light, poses, EXPOSURE_US, k, image)
            frame = m.Frame(0, k, image, pattern_set.text, slot, 1, EXPOSURE_US, 0, k)
            self._frames.append(frame)
            self._samples.append(bytearray(codec.encode(frame)))

    def __getitem__(self, k: int) -> memoryview:
        """The k-th frame, encoded; only its header is written anew, as a grabber does."""
        frame, sample = self._frames[k % len(self._frames)], self._samples[k % len(self._frames)]
        image = np.frombuffer(sample, np.uint8, offset=codec.DATA_OFFSET).reshape(frame.image.shape)
        codec.encode_into(replace(frame, sequence=k, stamp_ns=time.time_ns(), image=image), sample)
        return memoryview(sample)

    def frozen(self, count: int) -> list[memoryview]:
        """So many frames, ready to be written."""
        return [memoryview(self._samples[k % len(self._samples)]) for k in range(count)]


class Measured:
    """Wall and CPU time of a block, all threads."""

    def __enter__(self) -> Measured:
        self._wall_s, self._cpu_s = time.perf_counter(), time.process_time()
        return self

    def __exit__(self, *_: object) -> None:
        self.wall_s = time.perf_counter() - self._wall_s
        self.cpu_s = time.process_time() - self._cpu_s


def show(what: str, size: int, measured: Measured, frames: int, note: str = "") -> None:
    cpu_ms = 1e3 * measured.cpu_s / frames
    print(
        f"  {what:44s}{size / 1e6 / measured.wall_s:8.0f} MB/s{cpu_ms:8.2f} ms CPU a frame  {note}",
        flush=True,
    )


def burst(scan: Scan, folder: Path) -> None:
    """As fast as each writer goes."""
    frames = scan.frozen(BURST)
    size = sum(map(len, frames))
    print(f"as fast as it goes: {BURST} frames of {len(frames[0]) / 1e6:.2f} MB")
    packer = Packer()
    packer(frames[0])  # compiles
    writers: tuple[tuple[str, Write], ...] = (
        ("bare write()", _bare),
        ("bare direct write", _bare_sink),
        ("endo3d", _ours),
        ("endo3d compact", lambda path, items: _ours(path, items, packer)),
        ("mcap Writer, 1 MiB chunks, CRC", _library),
        ("foxglove-sdk writer", _foxglove),
    )
    for place in ("null", "disk"):
        for name, write in writers:
            if place == "null" and write is _foxglove:
                continue  # it wants a file that it can seek in
            path = Path("/dev/null") if place == "null" else _fresh(folder)
            with Measured() as measured:
                written = write(path, frames)
            note = f"{size / written:.2f}:1" if written else ""
            show(f"{name} -> {place}", size, measured, BURST, note)
            if place == "disk":
                path.unlink()


Write = Callable[[Path, list[memoryview]], int]
"""Writes frames into a file; the bytes it took where that says something."""


def _fresh(folder: Path) -> Path:
    """Where nothing waits to be written any more."""
    os.sync()
    return folder / "burst.mcap"


def _bare(path: Path, frames: list[memoryview]) -> int:
    with path.open("wb", buffering=0) as file:
        for frame in frames:
            file.write(frame)
    return 0


def _bare_sink(path: Path, frames: list[memoryview]) -> int:
    sink = file_sink(path)
    for frame in frames:
        sink.write(frame)
    sink.close()
    return 0


def _ours(path: Path, frames: list[memoryview], pack: Packer | None = None) -> int:
    writer = Writer(file_sink(path), "bench")
    channel = writer.channel("/frame", FRAME_KIND)
    for k, frame in enumerate(frames):
        writer.put(channel, k, START_NS + k, START_NS + k, *(pack(frame) if pack else (frame,)))
    writer.finish()
    return writer.size if pack else 0


def _library(path: Path, frames: list[memoryview]) -> int:
    with path.open("wb") as file:
        writer = LibraryWriter(file, compression=CompressionType.NONE)
        writer.start()
        schema = writer.register_schema(FRAME_KIND.name, FRAME_KIND.encoding, FRAME_KIND.definition)
        channel = writer.register_channel("/frame", "protobuf", schema)
        for k, frame in enumerate(frames):
            writer.add_message(channel, START_NS + k, frame, START_NS + k, k)  # type: ignore[arg-type]  # any buffer
        writer.finish()  # type: ignore[no-untyped-call]
    return 0


def _foxglove(path: Path, frames: list[memoryview]) -> int:
    context = foxglove.Context()
    options = MCAPWriteOptions(compression=None)
    with foxglove.open_mcap(str(path), context=context, writer_options=options):
        schema = foxglove.Schema(name=FRAME_KIND.name, encoding="protobuf", data=FRAME_KIND.definition)
        channel = foxglove.Channel("/frame", message_encoding="protobuf", schema=schema, context=context)
        for k, frame in enumerate(frames):
            channel.log(bytes(frame.obj), log_time=START_NS + k)  # it takes only bytes
    return 0


def paced(scan: Scan, folder: Path, seconds: float) -> None:
    print(f"paced {RATE_HZ:.0f} Hz, with poses: the recorder's step and its thread")
    for name, compact, crop, duration_s in (
        ("raw", False, False, seconds),
        ("compact", True, False, seconds),
        ("cropped", False, True, seconds / 2),
        ("cropped and compact", True, True, seconds / 2),
    ):
        config = RecorderConfig(directory=folder, name=name, head=str(HEAD), compact=compact, crop=crop)
        recorder = Recorder(config)
        recorder.open()
        count, deepest = round(duration_s * RATE_HZ), 0
        with Measured() as measured:
            began_s = time.perf_counter()
            for k in range(count):
                time.sleep(max(0.0, began_s + k / RATE_HZ - time.perf_counter()))
                _take(recorder, topics.FRAME, scan[k])
                _take(recorder, topics.POSE, POSE)
                deepest = max(deepest, round(recorder.values()["queued"]))
            recorder.close()
        path = folder / f"{name}.mcap"
        kept = Log(path).count(topics.FRAME)
        share = 100 * measured.cpu_s / measured.wall_s
        mb_s = path.stat().st_size / 1e6 / measured.wall_s
        held_hz = count / measured.wall_s
        print(
            f"  {name:22s}{share:5.0f} % of a core{mb_s:7.0f} MB/s{held_hz:7.1f} Hz"
            f"{count - kept:6d} of {count} dropped, queue <= {deepest}",
            flush=True,
        )
        if name != "raw":
            path.unlink()


def _take(recorder: Recorder, topic: Topic, encoded: memoryview) -> None:
    for _ in recorder.take(Sample(topic, "", encoded, time.time_ns())):
        raise AssertionError("a recorder says nothing")


def reading(path: Path) -> None:
    """The log of the paced run."""
    print(f"reading a log of {path.stat().st_size / 1e9:.1f} GB")
    _forget(path)
    for state in ("cold", "warm"):
        with Measured() as measured:
            count = sum(1 for _ in Log(path).messages(topics.POSE))
        print(f"  open and read {count} poses, {state}: {1e3 * measured.wall_s:.1f} ms")
    log = Log(path)
    start_ns = log.start_ns + 500_000_000
    with Measured() as measured:
        frames = list(log.messages(topics.FRAME, start_ns=start_ns, end_ns=start_ns + 100_000_000))
    print(f"  a window of 0.1 s, {len(frames)} frames, cold: {1e3 * measured.wall_s:.1f} ms")
    end_ns = log.start_ns + round(BURST / RATE_HZ * 1e9)
    for state in ("cold", "warm"):
        for name, read in (("endo3d", _read), ("mcap make_reader", _read_by_library)):
            if state == "cold":
                _forget(path)
            with Measured() as measured:
                size, count = read(path, end_ns)
            show(f"{name}, frames with CRC, {state}", size, measured, count)


def _read(path: Path, end_ns: int) -> tuple[int, int]:
    frames = Log(path).messages(topics.FRAME, end_ns=end_ns)
    sizes = [frame.image.nbytes for frame in frames if isinstance(frame, m.Frame)]
    return sum(sizes), len(sizes)


def _read_by_library(path: Path, end_ns: int) -> tuple[int, int]:
    with path.open("rb") as file:
        read = make_reader(file, validate_crcs=True).iter_messages(topics=["/frame"], ending_before=end_ns)
        sizes = [len(message.data) for _, _, message in read]
    return sum(sizes), len(sizes)


def _forget(path: Path) -> None:
    """Take a file out of the kernel's memory."""
    with path.open("rb") as file:
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def replaying(path: Path) -> None:
    """The decoder's very steps over the recorded frames, at 4 x 4 bins."""
    log = Log(path)
    end_ns = log.start_ns + round(BURST / RATE_HZ * 1e9)
    recorded_s = (end_ns - log.start_ns) * 1e-9
    print(f"replay of the decode, bins of 4 px, {recorded_s:.2f} s of the log")
    for name, keys in (
        ("default: windowed fit, depth map", ""),
        ("published three-frame form, clouds only", 'form = "three"\ndepth = false\n'),
    ):
        stack = stack_file.loads(f'[rig]\nhead = "{HEAD.stem}"\n[decoder]\nbin_px = 4\n{keys}')
        with engine.pipeline_of(stack) as pipeline:
            for _ in engine.replay(log, pipeline, end_ns=log.start_ns + 200_000_000):
                pass  # the look-up tables of the first frame
            with Measured() as measured:
                results = engine.replay(log, pipeline, end_ns=end_ns)
                clouds = sum(isinstance(result.message, m.Cloud) for result in results)
        print(
            f"  {name:44s}{clouds:5d} clouds in {measured.wall_s:.2f} s: "
            f"{recorded_s / measured.wall_s:.1f} x real time, {measured.cpu_s / measured.wall_s:.1f} cores"
        )


def main(seconds: float) -> None:
    scan = Scan()
    with tempfile.TemporaryDirectory(prefix="endo3d-bench-") as name:
        folder = Path(name)
        burst(scan, folder)
        paced(scan, folder, seconds)
        reading(folder / "raw.mcap")
        replaying(folder / "raw.mcap")


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 60.0)
