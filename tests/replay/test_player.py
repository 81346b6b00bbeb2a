"""A log acts as the camera: at its pace, again and again, from anywhere."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded import PERIOD_NS, frame, projector, record, same, scan

from endo3d.schemas import topics
from endo3d.schemas.messages import Frame, Message, Mode, ServiceState, Status, Truth
from endo3d.services.archive.reader import Log, Unreadable
from endo3d.services.player import Player, PlayerConfig
from endo3d.services.runtime.errors import UserError
from endo3d.services.runtime.service import Refused

NOW_NS = 5_000_000_000_000_000_000
FRAMES = 10


class Clock:
    """Time that passes only by waiting."""

    def __init__(self) -> None:
        self.now_ns = NOW_NS

    def wait(self, seconds: float) -> None:
        assert seconds >= 0
        self.now_ns += round(seconds * 1e9)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("player") / "log.mcap", scan(FRAMES))


def player(log: Path, **config: Any) -> tuple[Player, Clock]:
    made, clock = Player(PlayerConfig(log=log, **config)), Clock()
    made.now_ns = lambda: clock.now_ns
    made.wait = clock.wait
    made.open()
    return made, clock


def play(made: Player, clock: Clock, polls: int = 10_000) -> list[tuple[int, Message]]:
    """(time, message) of everything until the end, or of so many polls."""
    played = []
    for _ in range(polls):
        if made.finished:
            break
        for message in made.poll(0.02):
            played.append((clock.now_ns, message))
    return played


def command(made: Player, verb: str, **parameters: Any) -> Mapping[str, Any]:
    (reply,) = made.command(verb, parameters, 0)
    assert isinstance(reply, Mapping)
    return reply


@pytest.mark.parametrize("rate", [0.5, 1.0, 4.0])
def test_frames_come_at_the_recorded_pace_times_the_rate(log: Path, rate: float) -> None:
    played = play(*player(log, rate=rate))
    frames = [(now_ns, message) for now_ns, message in played if isinstance(message, Frame)]
    assert [message.sequence for _, message in frames] == list(range(FRAMES))
    for number, (now_ns, message) in enumerate(frames):
        due_ns = NOW_NS + number * PERIOD_NS / rate
        assert message.stamp_ns == pytest.approx(due_ns, abs=1)
        assert now_ns == pytest.approx(due_ns, abs=2)
        assert np.array_equal(message.image, frame(number).image)


def test_truth_and_mode_stay_with_their_frames(log: Path) -> None:
    played = [message for _, message in play(*player(log))]
    frames = {message.sequence: message for message in played if isinstance(message, Frame)}
    truths = [message for message in played if isinstance(message, Truth)]
    assert len(truths) == FRAMES
    assert all(item.stamp_ns == frames[item.sequence].stamp_ns for item in truths)
    assert all(item.trigger_ns == item.stamp_ns - 2_500_000 for item in frames.values())
    (mode,) = [message for message in played if isinstance(message, Mode)]
    assert mode.start_ns - mode.stamp_ns == 1_000
    assert played.index(mode) < played.index(frames[0])


def test_what_is_not_restamped_is_the_same_bits(log: Path) -> None:
    played = [message for _, message in play(*player(log, restamp=False))]
    recorded = list(Log(log).messages(*Player.writes))
    assert len(played) == len(recorded) == 2 * FRAMES + 2
    assert all(same(left, right) for left, right in zip(played, recorded, strict=True))


def test_as_fast_as_possible_waits_for_nothing(log: Path) -> None:
    made, clock = player(log, rate=math.inf)
    played = play(made, clock)
    assert {now_ns for now_ns, _ in played} == {NOW_NS}
    assert len(played) == 2 * FRAMES + 2
    assert {message.stamp_ns for _, message in played} == {NOW_NS}


def test_a_loop_counts_on_in_a_new_epoch(log: Path) -> None:
    made, clock = player(log, loop=True)
    played = [m for _, m in play(made, clock, polls=400) if isinstance(m, Frame)]
    assert len(played) > 3 * FRAMES
    assert [message.sequence for message in played] == list(range(len(played)))
    epochs = [message.epoch for message in played]
    assert all(len(set(epochs[i : i + FRAMES])) == 1 for i in range(0, 3 * FRAMES, FRAMES))
    assert len(set(epochs)) == -(-len(played) // FRAMES)
    stamps = [message.stamp_ns for message in played]
    assert stamps == sorted(set(stamps))
    assert [m.slot for m in played[FRAMES : 2 * FRAMES]] == [n % 4 for n in range(FRAMES)]


def test_seek(log: Path) -> None:
    made, clock = player(log)
    before = play(made, clock, polls=8)
    reply = command(made, "seek", s=0.05)
    assert reply["position_s"] == 0.05
    first, second = (m for _, m in play(made, clock, polls=20)[:4] if isinstance(m, Frame))
    assert np.array_equal(first.image, frame(5).image)
    seen = [message for _, message in before if isinstance(message, Frame)]
    assert first.sequence == seen[-1].sequence + 1
    assert first.epoch != seen[-1].epoch
    assert second.stamp_ns - first.stamp_ns == PERIOD_NS
    for wrong in (-1, 1000, math.nan, "x"):
        with pytest.raises(Refused):
            command(made, "seek", s=wrong)
    with pytest.raises(Refused, match="this service knows: seek, rate"):
        command(made, "jump")


def test_the_rate_can_change_and_pause(log: Path) -> None:
    made, clock = player(log)
    play(made, clock, polls=6)
    command(made, "rate", rate=0)
    paused_ns = clock.now_ns
    assert play(made, clock, polls=50) == []
    assert clock.now_ns - paused_ns == pytest.approx(50 * 0.02e9)
    assert command(made, "rate", rate=2)["rate"] == 2
    frames = [m.stamp_ns for _, m in play(made, clock) if isinstance(m, Frame)]
    assert set(np.diff(frames)) == {PERIOD_NS // 2}


def test_a_part_of_the_log_and_some_topics(log: Path) -> None:
    made, clock = player(log, start_s=0.03, end_s=0.06, topics=("frame",))
    played = [message for _, message in play(made, clock)]
    assert [type(message) for message in played] == [Frame] * 3
    assert [np.array_equal(m.image, frame(3 + i).image) for i, m in enumerate(played)] == [True] * 3


def test_a_long_gap_between_calibration_and_frames_is_not_waited_for(tmp_path: Path) -> None:
    """Calibration is published once, minutes before somebody starts the recording."""
    early = projector()
    late = [frame(number) for number in range(10_000, 10_003)]
    made, clock = player(record(tmp_path / "log.mcap", [early, *late]))
    played = play(made, clock)
    assert [topics.of(message) for _, message in played] == [topics.PROJECTOR] + 3 * [topics.FRAME]
    assert played[-1][0] - NOW_NS == pytest.approx(2 * PERIOD_NS, abs=10)


def test_nothing_is_played_before_the_others_are_ready(log: Path) -> None:
    made, clock = player(log, after=("decoder", "odometry"))

    def say(service: str, state: ServiceState) -> None:
        status = Status(NOW_NS, service, "host", 1, state, "", 0.0, 0.0, 0.0, 0.0, 0.0)
        assert list(made.step(status)) == []

    say("decoder", ServiceState.READY)
    say("odometry", ServiceState.STARTING)
    assert play(made, clock, polls=10) == []
    say("odometry", ServiceState.RUNNING)
    assert len(play(made, clock)) == 2 * FRAMES + 2


def test_what_cannot_be_played(tmp_path: Path, log: Path) -> None:
    with pytest.raises(ValueError, match="can't play cloud"):
        PlayerConfig(log=log, topics=("cloud",))
    with pytest.raises(UserError, match=r"start_s = 99.0: the log is 0.1 s long"):
        Player(PlayerConfig(log=log, start_s=99)).open()
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(log.read_bytes()[:-1])
    with pytest.raises(Unreadable, match="endo3d recover"):
        Player(PlayerConfig(log=torn)).open()
    empty = record(tmp_path / "poses.mcap", [projector()])
    made, clock = player(empty, loop=True, topics=("frame",))
    assert play(made, clock) == []
    assert made.finished
