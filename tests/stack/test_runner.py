"""The runner: what a service may rely on, and what others see of it."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from bus_peers import frame, wait_for
from peers import new_rig
from runner_peers import Halver, Keeper, Ticker

from endo3d.schemas import codec, topics
from endo3d.schemas.messages import DepthMap, Frame, Level, LogLine, Message, Mode, ServiceState, Status
from endo3d.services.runtime.bus import Bus
from endo3d.services.runtime.errors import UserError
from endo3d.services.runtime.log import BusHandler
from endo3d.services.runtime.runner import Runner
from endo3d.services.runtime.service import Config, Refused, Service
from endo3d.services.runtime.turn import Turn


class Seen:
    """Messages as they come, to wait for one that fits."""

    def __init__(self) -> None:
        self.messages: list[Any] = []
        self._came = threading.Condition()

    def take(self, message: Message) -> None:
        with self._came:
            self.messages.append(message)
            self._came.notify_all()

    def wait(self, fits: Callable[[Any], bool]) -> Any:
        with self._came:
            assert self._came.wait_for(lambda: any(map(fits, self.messages)), 90), "no such message came"
            return next(filter(fits, self.messages))


class Running:
    """A service on its runner in a thread."""

    def __init__(self, service: Service[Any], bus: Bus) -> None:
        self.runner = Runner(service, bus)
        self.code: int | None = None
        self.error: BaseException | None = None
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        try:
            self.code = self.runner.run()
        except Exception as error:
            self.error = error

    def join(self) -> None:
        self._thread.join(90)
        assert not self._thread.is_alive()

    def stop(self) -> None:
        self.runner.stop()
        self.join()


@contextmanager
def running(service: Service[Any], rig: str, name: str) -> Iterator[Running]:
    with Bus.open(rig, name=name) as bus:
        run = Running(service, bus)
        try:
            yield run
        finally:
            run.stop()


@pytest.fixture
def rig() -> str:
    return new_rig()


@pytest.fixture
def outside(rig: str) -> Iterator[Bus]:
    with Bus.open(rig, name="outside") as bus:
        yield bus


def watch(bus: Bus, topic: topics.Topic) -> Seen:
    seen = Seen()
    bus.subscribe(topic, seen.take)
    return seen


# ---------------------------------------------------------------- work


def test_a_source_and_a_service_work_together(outside: Bus, rig: str) -> None:
    depths = watch(outside, topics.DEPTH)
    with running(Halver(Config()), rig, "halver"), running(Ticker(Config()), rig, "ticker"):
        depth: DepthMap = depths.wait(lambda message: message.sequence >= 20)
        assert depth.depth.shape == (12, 16)
        assert (depth.depth == depth.sequence % 251).all()


def test_a_status_a_second_says_how_it_does(outside: Bus, rig: str) -> None:
    statuses = watch(outside, topics.STATUS)
    with running(Halver(Config()), rig, "halver"), running(Ticker(Config()), rig, "ticker"):
        halver: Status = statuses.wait(lambda status: status.service == "halver" and status.rate_hz > 20)
        ticker: Status = statuses.wait(lambda status: status.service == "ticker" and status.rate_hz > 20)
    assert halver.pid == os.getpid()
    assert halver.values == {"answer": 42.0}
    assert halver.dropped["depth:clipped"] == 3
    assert halver.published["depth"] <= halver.received["frame"] <= ticker.published["frame"] + 200
    assert 0 < halver.latency_p50_ms <= halver.latency_p99_ms < 5_000
    assert ticker.state is ServiceState.RUNNING
    assert ticker.memory_mb > 1
    last = statuses.wait(lambda status: status.service == "halver" and status.state is ServiceState.STOPPED)
    assert last.dropped["depth:clipped"] == 3


def test_alive_only_when_warm(outside: Bus, rig: str) -> None:
    release = threading.Event()

    class Slow(Halver):
        def warm(self) -> None:
            assert release.wait(90)

    statuses = watch(outside, topics.STATUS)
    with running(Slow(Config()), rig, "slow"):
        statuses.wait(lambda status: status.state is ServiceState.STARTING)
        assert outside.alive() == set()
        release.set()
        wait_for(outside, "slow")
        statuses.wait(lambda status: status.state is ServiceState.READY or status.rate_hz >= 0)


def test_a_tap_gets_what_travels_undecoded(outside: Bus, rig: str) -> None:
    keeper = Keeper(Config())
    with running(keeper, rig, "keeper"):
        wait_for(outside, "keeper")
        sent = frame(outside, 4, loaned=False)
        outside.publish(sent)
        outside.publish(LogLine(1, Level.INFO, "hello", "grabber"))
        deadline = time.monotonic() + 90
        while len(keeper.kept) < 2 and time.monotonic() < deadline:
            time.sleep(0.01)
    kept = {(topic, source): (payload, valid) for topic, source, payload, valid in keeper.kept}
    assert kept["frame", ""] == (codec.encode(sent), True)
    assert codec.decode(topics.LOG, kept["log", "grabber"][0]).message == "hello"  # type: ignore[union-attr]


def test_newest_only_reads_skip_without_a_loss(outside: Bus, rig: str) -> None:
    stepping, release = threading.Event(), threading.Event()

    class Viewer(Halver):
        newest = (topics.FRAME,)

        def step(self, message: Message) -> Iterator[Message]:
            stepping.set()
            assert release.wait(90)
            yield from super().step(message)

    depths = watch(outside, topics.DEPTH)
    with Bus.open(rig, name="viewer") as bus:
        run = Running(Viewer(Config()), bus)
        wait_for(outside, "viewer")
        for sequence in range(60):
            outside.publish(frame(outside, sequence, (24, 32)))
            assert stepping.wait(90)  # on the first of them, until all are sent
        release.set()
        depths.wait(lambda depth: depth.sequence == 59)
        run.stop()
        assert len(depths.messages) < 60
        assert bus.tally.dropped == {}


def test_what_is_looked_at_now_and_then_costs_no_more_and_the_last_is_seen(outside: Bus, rig: str) -> None:
    class Looker(Halver):
        def newest_hz(self, topic: topics.Topic) -> float | None:
            return 5.0

    depths = watch(outside, topics.DEPTH)
    with Bus.open(rig, name="looker") as bus:
        run = Running(Looker(Config()), bus)
        wait_for(outside, "looker")
        began_s = time.monotonic()
        for sequence in range(100):
            outside.publish(frame(outside, sequence, (24, 32)))
            time.sleep(0.005)
        depths.wait(lambda depth: depth.sequence == 99)
        run.stop()
        assert len(depths.messages) <= 2 + 5 * (time.monotonic() - began_s)
        assert bus.tally.dropped == {}


def test_a_source_that_ends_ends_its_process_with_zero(rig: str) -> None:
    ticker = Ticker(Config())
    ticker.limit = 5
    with Bus.open(rig, name="ticker") as bus:
        run = Running(ticker, bus)
        run.join()
        assert run.code == 0
        assert bus.tally.published["frame"] == 5


# ---------------------------------------------------------------- commands


def test_commands_reach_a_busy_source(outside: Bus, rig: str) -> None:
    modes = watch(outside, topics.MODE)
    with running(Ticker(Config()), rig, "ticker"):
        assert outside.call("ticker", "mode", {"name": "conventional"}) == {"epoch": 1}
        mode: Mode = modes.wait(lambda message: message.mode == "conventional")
        assert mode.running
        for _ in range(20):  # none of them may starve beside a source that never rests
            outside.call("ticker", "count", timeout_s=90)
        with pytest.raises(Refused, match="say which"):
            outside.call("ticker", "mode")
        with pytest.raises(Refused, match="no command 'dance'; this service knows: count, mode"):
            outside.call("ticker", "dance")


def test_turns_are_taken_in_order_of_arrival() -> None:
    turn, order = Turn(), []
    first_in, arrived = threading.Event(), threading.Semaphore(0)

    def want(number: int) -> None:
        arrived.release()
        with turn:
            order.append(number)

    threads = []
    with turn:
        first_in.set()
        for number in range(5):
            threads.append(threading.Thread(target=want, args=(number,)))
            threads[-1].start()
            assert arrived.acquire(timeout=90)
            while len(turn._waiting) <= number:
                time.sleep(0.001)
    for thread in threads:
        thread.join()
    assert order == [0, 1, 2, 3, 4]


# ---------------------------------------------------------------- failures


def test_a_failing_step_is_counted_named_once_and_survived(
    outside: Bus, rig: str, caplog: pytest.LogCaptureFixture
) -> None:
    halver = Halver(Config())
    halver.bad = frozenset({1, 3})
    depths, lines = watch(outside, topics.DEPTH), watch(outside, topics.LOG)
    with Bus.open(rig, name="halver") as bus:
        run = Running(halver, bus)
        wait_for(outside, "halver")
        for sequence in range(5):
            outside.publish(frame(outside, sequence, (24, 32)))
        depths.wait(lambda depth: depth.sequence == 4)
        line: LogLine = lines.wait(lambda line: line.level is Level.ERROR)
        assert line.service == "halver"
        assert "frame 1 is bad" in line.message
        run.stop()
        assert run.code == 0
        assert bus.tally.dropped == {"frame:failed": 2}
    assert [depth.sequence for depth in depths.messages] == [0, 2, 4]
    assert [record.levelname for record in caplog.records if "is bad" in record.message] == ["ERROR"]


def test_a_service_that_only_fails_ends_as_failed(outside: Bus, rig: str) -> None:
    halver = Halver(Config())
    halver.bad = frozenset(range(100))
    statuses = watch(outside, topics.STATUS)
    with Bus.open(rig, name="halver") as bus:
        run = Running(halver, bus)
        wait_for(outside, "halver")
        sequence = 0
        while run.code is None and sequence < 100:
            outside.publish(frame(outside, sequence, (24, 32)))
            sequence += 1
            time.sleep(0.01)
        run.join()
        assert run.code == 1
    status: Status = statuses.wait(lambda status: status.state is ServiceState.FAILED)
    assert "is bad" in status.note
    assert halver.closed == 1


def test_what_open_refuses_comes_through_and_is_closed(outside: Bus, rig: str) -> None:
    class NoCamera(Halver):
        def open(self) -> None:
            raise UserError("no camera at usb:3; plug it in")

    service = NoCamera(Config())
    statuses = watch(outside, topics.STATUS)
    outside.declare_alive()
    with Bus.open(rig, name="halver") as bus:
        wait_for(bus, "outside")
        run = Running(service, bus)
        run.join()
    assert isinstance(run.error, UserError)
    assert service.closed == 1
    assert "plug it in" in statuses.wait(lambda status: status.state is ServiceState.FAILED).note


def test_a_status_survives_a_service_that_can_not_answer(outside: Bus, rig: str) -> None:
    class Mute(Halver):
        def values(self) -> Mapping[str, float]:
            raise AttributeError("not open yet")

    statuses = watch(outside, topics.STATUS)
    with running(Mute(Config()), rig, "mute"):
        statuses.wait(lambda status: status.dropped.get("status:failed", 0) >= 2)


def test_results_from_void_memory_are_not_published(outside: Bus, rig: str, monkeypatch: pytest.MonkeyPatch) -> None:
    told = threading.Event()

    class Told(Halver):
        def void(self) -> None:
            told.set()

    depths = watch(outside, topics.DEPTH)
    with Bus.open(rig, name="halver") as bus:
        run = Running(Told(Config()), bus)
        wait_for(outside, "halver")
        outside.publish(frame(outside, 0, (24, 32)))
        depths.wait(lambda depth: depth.sequence == 0)
        assert not told.is_set()
        monkeypatch.setattr(bus, "intact", lambda: False)
        outside.publish(frame(outside, 1, (24, 32)))
        assert told.wait(90)
        assert bus.tally.dropped == {"frame:invalidated": 1}
        monkeypatch.undo()
        outside.publish(frame(outside, 2, (24, 32)))
        depths.wait(lambda depth: depth.sequence == 2)
        run.stop()
    assert [depth.sequence for depth in depths.messages] == [0, 2]


# ---------------------------------------------------------------- a process


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT], ids=lambda number: number.name)
def test_a_signal_ends_the_process_cleanly(outside: Bus, rig: str, number: int) -> None:
    program = (
        "import sys; from endo3d.services.runtime import runner;"
        "from endo3d.services.runtime.service import Config; from runner_peers import Ticker;"
        f"sys.exit(runner.run(Ticker(Config()), rig={rig!r}, name='ticker'))"
    )
    statuses, frames = watch(outside, topics.STATUS), watch(outside, topics.FRAME)
    process = subprocess.Popen(
        [sys.executable, "-c", program], stderr=subprocess.PIPE, text=True, cwd=Path(__file__).parent
    )
    try:
        frames.wait(lambda message: isinstance(message, Frame) and message.sequence > 3)
        process.send_signal(number)
        _, errors = process.communicate(timeout=90)
    finally:
        process.kill()
    assert process.returncode == 0
    assert errors == "INFO ready\n"
    assert statuses.wait(lambda status: status.state is ServiceState.STOPPED).service == "ticker"


# ---------------------------------------------------------------- log lines


def test_log_records_become_log_lines_not_more_than_twenty_a_second() -> None:
    sent: list[LogLine] = []
    handler = BusHandler("decoder", sent.append)
    logger = logging.getLogger("test-log-lines")
    logger.addHandler(handler)
    try:
        for number in range(100):
            logger.warning("line %d", number)
        assert 20 <= len(sent) <= 40  # a second may turn in between
        assert (sent[0].message, sent[0].level, sent[0].service) == ("line 0", Level.WARNING, "decoder")
        assert sent[0].file == "test_runner.py"
        handler._second -= 1
        logger.error("afterwards")
    finally:
        logger.removeHandler(handler)
    assert sent[-1].level is Level.ERROR
    assert f"(and {100 - len(sent) + 1} more lines before this one)" in sent[-1].message


def test_a_record_about_sending_a_record_is_not_sent() -> None:
    sent: list[LogLine] = []
    logger = logging.getLogger("test-log-loop")

    def publish(line: LogLine) -> None:
        sent.append(line)
        logger.error("could not send %s", line.message)

    handler = BusHandler("decoder", publish)
    logger.addHandler(handler)
    try:
        logger.warning("once")
    finally:
        logger.removeHandler(handler)
    assert [line.message for line in sent] == ["once"]
