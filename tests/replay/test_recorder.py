"""The recorder keeps the very bytes that travelled, at the rates asked for, with all that explains them."""

from __future__ import annotations

import hashlib
import tomllib
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf.message import Message as ProtobufMessage
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from recorded import START_NS, YAML, frame, mode, pose, projector, record, same, sample, scan, take

from endo3d.schemas import codec, topics
from endo3d.schemas.messages import Frame, Level, LogLine
from endo3d.services.archive.compact import Packer, unpack
from endo3d.services.archive.crop import Crop
from endo3d.services.archive.entry import entry_of
from endo3d.services.archive.reader import Log
from endo3d.services.recorder import Recorder, RecorderConfig
from endo3d.services.runtime.errors import UserError
from endo3d.services.runtime.service import Refused, Sample


def recorder(directory: Path, **config: Any) -> Recorder:
    made = Recorder(RecorderConfig(directory=directory, name="log", **{"floor_mb": 0, "reserve_mb": 0} | config))
    made.open()
    return made


def command(service: Recorder, verb: str, **parameters: Any) -> Mapping[str, Any]:
    (reply,) = service.command(verb, parameters, START_NS)
    assert isinstance(reply, Mapping)
    return reply


def test_the_received_bytes_are_the_logged_bytes(tmp_path: Path) -> None:
    messages = scan(20)
    log = Log(record(tmp_path / "log.mcap", messages))
    expected = sorted((sample(message) for message in messages), key=lambda s: s.received_ns)
    for got, sent in zip(log.records(), expected, strict=True):
        assert got.payload == sent.payload
        assert got.stream.topic is sent.topic
        assert got.log_ns == sent.received_ns
        assert got.publish_ns == codec.decode(sent.topic, sent.payload).stamp_ns


def test_a_log_explains_itself(tmp_path: Path) -> None:
    stack = '[rig]\nname = "bench"\n'
    log = Log(record(tmp_path / "log.mcap", scan(2), stack_toml=stack, rig="bench"))
    assert log.attachments == {"stack.toml": stack.encode(), "calibration.yaml": YAML.encode()}
    for name, content in log.attachments.items():
        assert log.facts[f"sha256:{name}"] == {"sha256": hashlib.sha256(content).hexdigest()}
    facts = log.facts["endo3d"]
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    assert facts["endo3d"] == project["version"]
    assert facts["rig"] == "bench"
    assert {"python", "platform", "processor", "cores", "host", "numpy", "started"} <= facts.keys()


def test_any_reader_of_protobuf_logs_reads_it(tmp_path: Path) -> None:
    """By the schemas in the log alone."""
    path = record(tmp_path / "log.mcap", scan(3))
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        decoded = [(schema.name, message) for schema, _, _, message in reader.iter_decoded_messages()]
    assert all(isinstance(message, ProtobufMessage) for _, message in decoded)
    images = [message for name, message in decoded if name == "foxglove.RawImage"]
    assert [(i.width, i.height, i.encoding, i.step) for i in images] == [(256, 300, "mono8", 256)] * 3
    assert [i.data for i in images] == [frame(number).image.tobytes() for number in range(3)]


def test_rates(tmp_path: Path) -> None:
    """100 Hz of frames and poses: frames at 25 Hz, poses never, truth as the table says."""
    log = Log(record(tmp_path / "log.mcap", scan(100), log_hz={"frame": 25, "pose": 0}))
    assert [message.sequence for message in log.messages(topics.FRAME)] == list(range(0, 100, 4))
    assert log.count(topics.POSE) == 0
    assert log.count(topics.TRUTH) == 100


def test_what_is_thinned_out_is_read_at_the_archives_rate(tmp_path: Path) -> None:
    service = recorder(tmp_path, log_hz={"frame": 30, "truth": 0})
    paces = {topic.name: service.newest_hz(topic) for topic in service.reads}
    service.close()
    assert paces.pop("frame") == 30
    assert paces.pop("truth") == 0
    assert paces.pop("cloud") == topics.CLOUD.log_hz
    assert paces.pop("depth") == topics.DEPTH.log_hz
    assert set(paces.values()) == {None}


@given(jitter=st.lists(st.integers(-3_000_000, 3_000_000), min_size=200, max_size=200))
def test_a_rate_holds_whatever_the_jitter(tmp_path: Path, jitter: list[int]) -> None:
    """30 Hz of a 100 Hz stream for 2 s, evenly."""
    service = recorder(tmp_path, log_hz={"frame": 30})
    times = [START_NS + 10_000_000 * i + late for i, late in enumerate(jitter)]
    small = frame(0, (2, 2))
    kept = [t for t in times if service._due(entry_of(small, log_ns=t), topics.FRAME)]
    service.close()
    assert 58 <= len(kept) <= 61
    assert all(later - earlier > 10_000_000 for earlier, later in pairwise(kept))


def test_an_unknown_topic_in_the_rates_is_refused() -> None:
    with pytest.raises(ValueError, match="no topic frames; known are frame"):
        RecorderConfig(log_hz={"frames": 1})


def test_start_and_stop(tmp_path: Path) -> None:
    service = recorder(tmp_path, autostart=False)
    take(service, [projector(), mode(), frame(0)])
    assert service.values() == {"recording": 0.0}
    with pytest.raises(Refused, match="not recording"):
        command(service, "stop")
    assert command(service, "start", name="first") == {"recording": str(tmp_path / "first.mcap")}
    with pytest.raises(Refused, match="already recording"):
        command(service, "start")
    take(service, [frame(1), frame(2)])
    reply = command(service, "stop")
    assert reply["files"] == [str(tmp_path / "first.mcap")]
    assert reply["messages"] == 4
    assert reply["dropped"] == 0
    log = Log(tmp_path / "first.mcap")
    # What was latched before the start is in the log: a log without its calibration is worth nothing.
    assert {stream.name: stream.count for stream in log.streams.values()} == {
        "/calibration/projector": 1,
        "/mode": 1,
        "/frame": 2,
    }
    assert log.attachments["calibration.yaml"] == YAML.encode()
    assert log.size == reply["bytes"]
    take(service, [frame(3)])
    service.close()
    assert list(tmp_path.iterdir()) == [tmp_path / "first.mcap"]


def test_what_cannot_be_recorded_to(tmp_path: Path) -> None:
    service = recorder(tmp_path, autostart=False)
    for name in ("../elsewhere", "/elsewhere", "a/b"):
        with pytest.raises(Refused, match="plain file name"):
            command(service, "start", name=name)
    service.close()
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(UserError, match=r"can't make the directory .*; choose another"):
        recorder(tmp_path / "file" / "logs")
    with pytest.raises(UserError, match="crop needs the head's file, and none is no such"):
        recorder(tmp_path, crop=True)


def test_a_directory_that_vanished_is_trouble_not_a_failure(tmp_path: Path) -> None:
    service = recorder(tmp_path / "logs")
    (tmp_path / "logs").rmdir()
    (tmp_path / "logs").write_bytes(b"in the way")
    take(service, [frame(0), frame(1)])
    assert "can't record into" in service.trouble()
    with pytest.raises(Refused, match="can't record into"):
        command(service, "start")
    (tmp_path / "logs").unlink()
    command(service, "start", name="after")
    take(service, [frame(2)])
    assert service.trouble() == ""
    service.close()
    assert Log(tmp_path / "logs" / "after.mcap").count(topics.FRAME) == 1


def test_status_of_several_services_go_to_channels_of_their_own(tmp_path: Path) -> None:
    service = recorder(tmp_path)
    for source in ("decoder", "odometry"):
        line = LogLine(START_NS, Level.INFO, f"from {source}", source)
        list(service.take(sample(line, source=source)))
    service.close()
    log = Log(tmp_path / "log.mcap")
    assert {(s.name, s.source, s.topic) for s in log.streams.values()} == {
        ("/log/decoder", "decoder", topics.LOG),
        ("/log/odometry", "odometry", topics.LOG),
    }
    assert [message.message for message in log.messages(topics.LOG)] == ["from decoder", "from odometry"]


def test_what_is_malformed_is_counted_and_what_was_reclaimed_too(tmp_path: Path) -> None:
    service = recorder(tmp_path)
    list(service.take(Sample(topics.POSE, "", memoryview(b"\xff\xff"), START_NS)))
    good = sample(frame(0))
    list(service.take(replace(good, valid=lambda: False)))
    list(service.take(good))
    assert service.losses() == {"pose:malformed": 1, "frame:disk": 1}
    service.close()
    assert service.losses() == {"pose:malformed": 1, "frame:disk": 1}
    assert Log(tmp_path / "log.mcap").count(topics.FRAME) == 1


@given(
    shape=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    kind=st.sampled_from((np.uint8, np.uint16)),
    seed=st.integers(0, 1000),
    smooth=st.booleans(),
)
def test_packing_is_lossless(
    shape: tuple[int, int], kind: type[np.unsignedinteger[Any]], seed: int, smooth: bool
) -> None:
    pixels = np.random.default_rng(seed).integers(0, np.iinfo(kind).max + 1, shape, kind)
    if smooth:
        pixels = np.sort(pixels, axis=0)
    sent = codec.encode(replace(frame(0), image=pixels))
    head, packed = Packer()(memoryview(sent))
    assert bytes(unpack(memoryview(head + packed))) == sent


@given(st.binary(max_size=200))
def test_what_is_not_packed_is_malformed(junk: bytes) -> None:
    with pytest.raises(codec.Malformed):
        unpack(memoryview(junk))
    sent = codec.encode(replace(frame(0), image=np.zeros((3, 4), np.uint8)))
    head, _ = Packer()(memoryview(sent))
    with pytest.raises(codec.Malformed):
        unpack(memoryview(head + junk))


def test_compact_halves_what_is_smooth(tmp_path: Path) -> None:
    ramp = np.add.outer(np.arange(600), np.arange(960)).astype(np.uint8)
    noisy = ramp + np.random.default_rng(0).integers(0, 4, ramp.shape, np.uint8)
    messages = [replace(frame(number), image=noisy) for number in range(3)]
    plain = record(tmp_path / "plain.mcap", messages)
    packed = record(tmp_path / "packed.mcap", messages, compact=True)
    assert packed.stat().st_size < 0.5 * plain.stat().st_size
    pairs = zip(Log(plain).messages(topics.FRAME), Log(packed).messages(topics.FRAME), strict=True)
    assert all(same(left, right) for left, right in pairs)


HEAD = Path(__file__).parents[2] / "deploy" / "heads" / "base6_wd20.yaml"


@pytest.mark.parametrize("compact", [False, True])
def test_cropped_to_the_image_circle(tmp_path: Path, compact: bool) -> None:
    """The circle's pixels are the same, what lies outside is zero, and the file is 40 % smaller."""
    sent = [frame(number, (1200, 1920)) for number in range(2)]
    whole = record(tmp_path / "whole.mcap", sent, compact=compact)
    cropped = record(tmp_path / "cropped.mcap", sent, crop=True, head=str(HEAD), compact=compact)
    assert cropped.stat().st_size < 0.64 * whole.stat().st_size
    v, u = np.ogrid[-599.5:600, -959.5:960]
    inside = u * u + v * v <= (1195 / 2) ** 2
    for got, expected in zip(Log(cropped).messages(topics.FRAME), sent, strict=True):
        assert isinstance(got, Frame)
        assert got.image.shape == (1200, 1920)
        assert np.array_equal(got.image[inside], expected.image[inside])
        assert not got.image[:, :350].any()
        assert same(replace(got, image=expected.image), expected)


def test_a_cropped_log_shows_smaller_images_to_others(tmp_path: Path) -> None:
    path = record(tmp_path / "log.mcap", [frame(0, (600, 960))], crop=True, head=str(HEAD))
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        ((_, channel, _, image),) = reader.iter_decoded_messages()
    side = 598 + 8
    assert (image.height, image.width) == (600, side)
    assert len(image.data) == 600 * side
    assert channel.metadata == {"crop": f"0 {(960 - side) // 2} 600 {side} 600 960"}


@given(st.floats(1, 3000), st.integers(1, 2000), st.integers(1, 2000))
def test_the_crop_holds_the_circle(diameter: float, rows: int, columns: int) -> None:
    crop = Crop.around_circle(diameter, rows, columns)
    assert Crop.from_metadata(crop.metadata()) == crop
    for middle, first, count, whole in (
        ((rows - 1) / 2, crop.row, crop.rows, rows),
        ((columns - 1) / 2, crop.column, crop.columns, columns),
    ):
        assert 0 <= first <= first + count <= whole
        assert first <= max(0, middle - diameter / 2)
        assert first + count - 1 >= min(whole - 1, middle + diameter / 2)


def test_a_frame_of_another_size_does_not_spoil_a_cropped_log(tmp_path: Path) -> None:
    service = recorder(tmp_path, crop=True, head=str(HEAD))
    take(service, [frame(0, (600, 960)), frame(1, (300, 480)), frame(2, (600, 960))])
    service.close()
    assert Counter(service.losses()).total() == 1
    assert [message.sequence for message in Log(tmp_path / "log.mcap").messages(topics.FRAME)] == [0, 2]


def test_a_foreign_layout_is_packed_as_well(tmp_path: Path) -> None:
    """A publisher that puts its pixels before other fields."""
    sent = frame(0, (30, 40))
    encoded = codec.encode(sent)
    start, _ = codec.data_span(encoded)
    tag = encoded.rindex(b"\x32", 0, start)
    foreign = encoded[tag:] + encoded[:tag]
    assert same(codec.decode(topics.FRAME, foreign), sent)
    service = recorder(tmp_path, compact=True)
    list(service.take(Sample(topics.FRAME, "", memoryview(foreign), START_NS)))
    service.close()
    (got,) = Log(tmp_path / "log.mcap").messages(topics.FRAME)
    assert same(got, sent)


def test_poses_arrive_in_order(tmp_path: Path) -> None:
    path = record(tmp_path / "log.mcap", [pose(number) for number in range(500)])
    assert [message.sequence for message in Log(path).messages(topics.POSE)] == list(range(500))
