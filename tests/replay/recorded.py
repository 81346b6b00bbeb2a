"""Messages to record, and logs made of them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from endo3d.schemas import codec, topics
from endo3d.schemas import messages as m
from endo3d.services.recorder import Recorder, RecorderConfig
from endo3d.services.runtime.service import Sample

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 10_000_000
"""Between frames: 100 Hz."""
YAML = "camera:\n  width: 64  # exactly these bytes: °\n"


def frame(sequence: int, shape: tuple[int, int] = (300, 256), epoch: int = 1) -> m.Frame:
    """A frame of noise that its sequence number determines."""
    return m.Frame(
        stamp_ns=START_NS + sequence * PERIOD_NS,
        sequence=sequence,
        image=np.random.default_rng(sequence).integers(0, 256, shape, np.uint8),
        pattern_set="interleaved f1=25",
        slot=sequence % 4,
        epoch=epoch,
        exposure_us=5000.0,
        trigger_ns=START_NS + sequence * PERIOD_NS - 2_500_000,
        camera_frame_id=sequence,
    )


def truth(sequence: int) -> m.Truth:
    return m.Truth(START_NS + sequence * PERIOD_NS, sequence, np.eye(4), "plane")


def pose(sequence: int) -> m.Pose:
    """A pose that its sequence number determines."""
    T = np.eye(4)
    T[0, 3] = sequence
    stamp_ns = START_NS + sequence * PERIOD_NS
    return m.Pose(stamp_ns, sequence, T, np.eye(6), m.Tracking.TRACKING, 1.0, np.eye(6)[0], 1.0, 0.5, 0.0)


def projector() -> m.ProjectorCalibration:
    return m.ProjectorCalibration(START_NS, 64, 64, np.eye(3), np.zeros(5), np.eye(4), YAML)


def mode(epoch: int = 1) -> m.Mode:
    return m.Mode(START_NS, "interleaved", "interleaved f1=25", epoch, START_NS + 1_000, PERIOD_NS, 5000.0, True)


def sample(message: m.Message, received_ns: int | None = None, source: str = "") -> Sample:
    """A message as it travels; it arrives 1 ms after its stamp unless told, and no two at the same time."""
    topic = topics.of(message)
    if received_ns is None:
        order = topics.TOPICS.index(topic) + (0 if topic.latched else 100)
        received_ns = message.stamp_ns + 1_000_000 + order
    return Sample(topic, source, memoryview(codec.encode(message)), received_ns)


def take(recorder: Recorder, messages: Iterable[m.Message]) -> None:
    for message in messages:
        assert list(recorder.take(sample(message))) == []


def scan(frames: int, shape: tuple[int, int] = (300, 256)) -> list[m.Message]:
    """What a short scan publishes."""
    messages: list[m.Message] = [projector(), mode()]
    for sequence in range(frames):
        messages += frame(sequence, shape), truth(sequence), pose(sequence)
    return messages


def record(path: Path, messages: Iterable[m.Message], **config: object) -> Path:
    """A log of messages; returns its path."""
    settings = {"floor_mb": 0, "reserve_mb": 0, **config}
    recorder = Recorder(RecorderConfig(directory=path.parent, name=path.stem, **settings))
    recorder.open()
    try:
        take(recorder, messages)
    finally:
        recorder.close()
    assert recorder.losses() == {}
    return path


def same(left: m.Message, right: m.Message) -> bool:
    return codec.encode(left) == codec.encode(right)
