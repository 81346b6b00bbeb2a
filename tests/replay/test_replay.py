"""The same input and configuration give the same bits, through the very steps that ran live."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recorded import record, same, scan
from rendered import RATE_HZ, STACK, messages, write
from typer.testing import CliRunner

from endo3d.schemas import codec, topics
from endo3d.schemas.messages import Cloud, Frame, Message
from endo3d.services.archive.reader import Log
from endo3d.services.cli.app import app
from endo3d.services.decoder import Decoder, DecoderConfig
from endo3d.services.runtime import replay as engine
from endo3d.services.runtime.errors import UserError

FRAMES = 16
BIN_PX = 4


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("replay") / "scan.mcap", FRAMES, BIN_PX)


def run(*arguments: str | Path) -> dict:
    """``endo3d replay``, as a user starts it."""
    result = CliRunner().invoke(app, ["replay", "--json", "--digest", *map(str, arguments)])
    if result.exception is not None:
        raise result.exception
    report: dict = json.loads(result.stdout)
    return report


def test_twice_the_same_bits(log: Path) -> None:
    first, second = run(log), run(log)
    assert first["digests"] == second["digests"]
    assert {"cloud", "depth", "pose", "map"} <= first["digests"].keys()
    assert first["results"]["cloud"] >= 10


def test_the_bits_of_the_live_steps(log: Path) -> None:
    """A decoder as a process builds it, fed with the messages as they were sent, gives the same."""
    head = engine.stack_file.stock("heads")["base6_wd20"]
    decoder = Decoder(DecoderConfig(head=str(head)))
    decoder.open()
    sent = [message for message in messages(FRAMES, BIN_PX) if isinstance(message, Frame)]
    live = [made for message in sent for made in decoder.step(message)]
    recorded = Log(log)
    with engine.stack_of(recorded) as stack, engine.pipeline_of(stack, ["decoder"]) as pipeline:
        replayed = [result.message for result in engine.replay(recorded, pipeline)]
    assert len(live) == len(replayed) > 0
    assert all(same(left, right) for left, right in zip(live, replayed, strict=True))


def test_a_frame_that_was_overwritten_is_in_no_window(log: Path) -> None:
    """The runner says so when a frame's memory was taken back while it was read."""
    recorded = Log(log)
    with engine.stack_of(recorded) as stack, engine.pipeline_of(stack, ["decoder"]) as pipeline:
        intact = points_of(result.message for result in engine.replay(recorded, pipeline))
    decoder = Decoder(DecoderConfig(head=str(engine.stack_file.stock("heads")["base6_wd20"])))
    decoder.open()
    made: list[Message] = []
    for frame in recorded.messages(topics.FRAME):
        assert isinstance(frame, Frame)
        if frame.sequence == 8:
            list(decoder.step(replace(frame, image=np.full_like(frame.image, 90))))
            decoder.void()
        else:
            made += decoder.step(frame)
    after = points_of(made)
    assert max(after) > 8 > min(after)
    assert after == {sequence: intact[sequence] for sequence in after}


def test_other_parameters(log: Path) -> None:
    whole, coarse = run(log, "--only", "decoder"), run(log, "--only", "decoder", "--set", "decoder.bin_px=2")
    assert whole["results"]["cloud"] == coarse["results"]["cloud"]
    assert whole["digests"] != coarse["digests"]
    without = run(log, "--only", "decoder", "--set", "decoder.depth=false")
    assert without["results"] == {"cloud": whole["results"]["cloud"]}
    assert without["digests"]["cloud"] == whole["digests"]["cloud"]


def test_results_into_a_log_that_replays_further(log: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    whole = run(log, "--out", str(out), "--set", "odometry.map_hz=10")
    made = Log(out)
    assert made.count(topics.CLOUD) == whole["results"]["cloud"]
    assert made.count(topics.TRUTH) == FRAMES
    assert made.count(topics.FRAME) == 0
    assert "map_hz = 10" in made.attachments["stack.toml"].decode()
    assert 'head = "base6_wd20"' in made.attachments["stack.toml"].decode()
    assert made.attachments["calibration.yaml"] == Log(log).attachments["calibration.yaml"]
    assert [m.stamp_ns for m in made.messages(topics.CLOUD)] == [
        record.publish_ns for record in made.records([topics.CLOUD])
    ]
    again = run(out, "--only", "odometry")
    assert again["digests"]["pose"] == whole["digests"]["pose"]
    same_again = tmp_path / "again.mcap"
    run(log, "--out", str(same_again), "--set", "odometry.map_hz=10")
    assert same_again.read_bytes() == out.read_bytes()


def test_a_cropped_and_packed_log_decodes_to_the_same_bits(log: Path, tmp_path: Path) -> None:
    """The virtual camera sees nothing outside of the image circle, so nothing is lost."""
    head = str(engine.stack_file.stock("heads")["base6_wd20"])
    packed = write(tmp_path / "packed.mcap", FRAMES, BIN_PX, crop=True, compact=True, head=head)
    assert packed.stat().st_size < 0.6 * log.stat().st_size
    assert run(packed, "--only", "decoder")["digests"] == run(log, "--only", "decoder")["digests"]


def test_the_parts_of_a_split_log_replay_as_one(log: Path, tmp_path: Path) -> None:
    write(tmp_path / "scan.mcap", FRAMES, BIN_PX, split_s=5.5 / RATE_HZ)
    parts = sorted(tmp_path.glob("scan_*.mcap"))
    assert len(parts) == 3
    assert run(*parts, "--only", "decoder")["digests"] == run(log, "--only", "decoder")["digests"]


def test_a_part_of_the_log(log: Path) -> None:
    late = run(log, "--only", "decoder", "--from", "0.03")
    assert 0 < late["results"]["cloud"] < run(log, "--only", "decoder")["results"]["cloud"]
    early = run(log, "--only", "decoder", "--to", "0.06")
    assert 0 < early["results"]["cloud"] < 16


def test_the_calibration_is_the_logs_own(tmp_path: Path) -> None:
    """Whatever the head of that name is today."""
    items = messages(8, BIN_PX)
    stack = STACK.replace("base6_wd20", "heads/long-gone.yaml")
    path = record(tmp_path / "log.mcap", items, stack_toml=stack)
    assert run(path, "--only", "decoder")["results"]["cloud"] > 0


def test_clouds_keep_their_frames_identity(log: Path) -> None:
    recorded = Log(log)
    frames = {message.sequence: message for message in recorded.messages(topics.FRAME)}
    with engine.stack_of(recorded) as stack, engine.pipeline_of(stack, ["decoder"]) as pipeline:
        for result in engine.replay(recorded, pipeline):
            if isinstance(result.message, Cloud):
                assert result.message.stamp_ns == frames[result.message.sequence].stamp_ns
                cause = codec.decode(topics.FRAME, result.cause.payload)
                assert result.message.newest_stamp_ns == cause.stamp_ns


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--only", "decoer"], "nearest is 'decoder'"),
        (["--topic", "frames"], "no topic frames"),
        (["--set", "decoder.sharpness=1"], "no key 'sharpness'"),
        (["--stack", "nowhere.toml"], "no stack 'nowhere.toml'"),
    ],
)
def test_what_is_wrong_is_said(log: Path, arguments: list[str], complaint: str) -> None:
    with pytest.raises(UserError, match=complaint):
        run(log, *arguments)


def test_a_log_without_a_stack_needs_one(tmp_path: Path) -> None:
    path = record(tmp_path / "log.mcap", scan(1))
    with pytest.raises(UserError, match="name one with --stack"):
        run(path)


@pytest.mark.slow
def test_the_live_stack_computes_the_same_bits(log: Path, tmp_path: Path) -> None:
    """Processes, shared memory and a clock in between change nothing of the points.

    A busy machine may lose frames on the way to the decoder: every cloud of a whole window is still the same.
    """
    out = tmp_path / "live.mcap"
    settings = [f"rig.name=replay{os.getpid()}", "recorder.log_hz={cloud = 180.0}"]
    command = [sys.executable, "-m", "endo3d.services.cli.app", "replay", str(log), "--rate", "0.02", "--out", str(out)]
    command += [part for setting in settings for part in ("--set", setting)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    live = Log(out)
    assert live.count(topics.FRAME) == live.count(topics.TRUTH) == FRAMES
    recorded = Log(log)
    with engine.stack_of(recorded) as stack, engine.pipeline_of(stack, ["decoder"]) as pipeline:
        replayed = points_of(result.message for result in engine.replay(recorded, pipeline))
    lived = points_of(live.messages(topics.CLOUD))
    assert lived
    assert lived == {sequence: replayed[sequence] for sequence in lived}


def points_of(messages: Iterable[Message]) -> dict[int, str]:
    """Frame number -> hash of its cloud's points."""
    clouds = (message for message in messages if isinstance(message, Cloud))
    return {cloud.sequence: hashlib.sha256(cloud.points).hexdigest() for cloud in clouds}
