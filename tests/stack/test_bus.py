"""The bus between real processes: every message arrives whole, and nobody can hold a writer up."""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np
import pytest
from bus_peers import SHAPE, Collector, frame, hold_frames, limited, read_frames, wait_for, write_frames
from peers import Peer, new_rig, segments

from endo3d.schemas import codec, topics
from endo3d.schemas.messages import Frame, Level, LogLine, MapDelta, Message, Mode
from endo3d.services.runtime import pool
from endo3d.services.runtime.bus import Bus
from endo3d.services.runtime.errors import UserError
from endo3d.services.runtime.pool import SLOTS
from endo3d.services.runtime.service import Exhausted, Refused


@pytest.fixture
def rig() -> str:
    return new_rig()


@contextmanager
def taken_ports(count: int) -> Iterator[int]:
    """Sixteen ports in a row, the first ``count`` of them taken by a program that is not ours."""
    for port in range(18_000, 20_000, 16):
        with ExitStack() as stack:
            try:
                for number in range(16):
                    taken = socket.create_server(("127.0.0.1", port + number))
                    stack.enter_context(taken) if number < count else taken.close()
            except OSError:
                continue
            yield port
            return
    pytest.fail("no free ports")


@pytest.fixture
def bus(rig: str) -> Iterator[Bus]:
    with Bus.open(rig, name="writer") as opened:
        yield opened


def mode(name: str) -> Mode:
    return Mode(
        stamp_ns=time.time_ns(),
        mode=name,
        pattern_set="interleaved f1=25",
        epoch=1,
        start_ns=0,
        frame_period_ns=5_555_556,
        exposure_us=2900.0,
        running=True,
    )


class First:
    """Waits for messages."""

    def __init__(self) -> None:
        self.messages: list[Message] = []
        self._came = threading.Event()

    def take(self, message: Message) -> None:
        self.messages.append(message)
        self._came.set()

    def wait(self) -> Any:
        assert self._came.wait(90), "no message came"
        return self.messages[0]


# ---------------------------------------------------------------- the ways a message can take


@pytest.mark.parametrize("loaned", [True, False], ids=["loaned", "copied"])
@pytest.mark.parametrize("reader_shares", [True, False], ids=["shm-reader", "network-reader"])
@pytest.mark.parametrize("writer_shares", [True, False], ids=["shm-writer", "network-writer"])
def test_frames_arrive_whole(rig: str, writer_shares: bool, reader_shares: bool, loaned: bool) -> None:
    with (
        Bus.open(rig, name="writer", shared_memory=writer_shares) as bus,
        Peer(read_frames, rig, {"shared_memory": reader_shares}) as reader,
    ):
        assert ("switched off" in reader.hear()) is not reader_shares
        wait_for(bus, "reader")
        for sequence in range(20):
            bus.publish(frame(bus, sequence, loaned=loaned))
            time.sleep(1 / 180)
        sequences, broken, dropped = reader.ask(("until", 19))
        assert broken == 0
        assert len(sequences) + dropped.get("frame:missed", 0) == 20
        reader.say("stop")
        assert reader.join() == 0


def test_without_a_view_both_sides_copy(rig: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool, "find_view", lambda owner, content: None)
    collector = Collector()
    with Bus.open(rig, name="writer") as writer, Bus.open(rig, name="reader") as reader:
        assert "no zero-copy view in zenoh" in writer.note
        reader.subscribe(topics.FRAME, collector.take)
        reader.declare_alive()
        wait_for(writer, "reader")
        writer.publish(frame(writer, 5))
        writer.publish(frame(writer, 6, loaned=False))
        collector.wait(6)
    assert collector.sequences == [5, 6]
    assert collector.broken == 0


def test_a_loaned_frame_is_the_readers_memory(rig: str) -> None:
    """What the writer (wrongly) writes after publishing shows up at the reader: there is no copy between."""
    first = First()
    with Bus.open(rig, name="writer") as writer, Bus.open(rig, name="reader") as reader:
        reader.subscribe(topics.FRAME, first.take)
        reader.declare_alive()
        wait_for(writer, "reader")
        sent = frame(writer, 1)
        writer.publish(sent)
        received = first.wait()
        assert not received.image.flags.writeable
        sent.image[7, 9] = 99
        assert received.image[7, 9] == 99


def test_part_of_a_loan_is_copied_as_what_it_is(rig: str) -> None:
    first = First()
    with Bus.open(rig, name="writer") as writer, Bus.open(rig, name="reader") as reader:
        reader.subscribe(topics.FRAME, first.take)
        reader.declare_alive()
        wait_for(writer, "reader")
        image = writer.loan(topics.FRAME, (40, 60), np.uint8)
        image[:] = np.arange(40)[:, None]
        writer.publish(Frame(1, 1, image[10:30, ::2], "", 0, 0, 1.0, 0, 1))
        np.testing.assert_array_equal(first.wait().image, np.arange(40)[10:30, None].repeat(30, axis=1))


def test_middling_messages_go_through_the_common_pool(rig: str) -> None:
    first = First()
    points = np.zeros(3000, [("x", "<f4"), ("kx", "<i2")])
    points["x"] = np.arange(3000)
    delta = MapDelta(1, 1, points, np.zeros((2, 3), np.int16), 4, False, 3000, 0.1)
    with Bus.open(rig, name="writer") as writer, Bus.open(rig, name="reader") as reader:
        reader.subscribe(topics.MAP, first.take)
        reader.declare_alive()
        wait_for(writer, "reader")
        writer.publish(delta)
        assert codec.encode(first.wait()) == codec.encode(delta)


# ---------------------------------------------------------------- any order, any time


def test_reader_before_writer(rig: str) -> None:
    with Peer(read_frames, rig, {}) as reader:
        reader.hear()
        with Bus.open(rig, name="writer") as bus:
            wait_for(bus, "reader")
            bus.publish(frame(bus, 3))
            assert reader.ask(("until", 3))[0] == [3]


def test_a_late_reader_gets_what_is_latched(bus: Bus, rig: str) -> None:
    bus.publish(mode("conventional"))
    bus.publish(mode("interleaved"))
    first = First()
    with Bus.open(rig, name="late") as late:
        late.subscribe(topics.MODE, first.take)
        assert first.wait().mode == "interleaved"


def test_an_early_reader_gets_what_a_late_writer_latched(rig: str) -> None:
    first = First()
    with Bus.open(rig, name="early") as early:
        early.subscribe(topics.MODE, first.take)
        with Bus.open(rig, name="writer") as writer:
            writer.publish(mode("interleaved"))
            assert first.wait().mode == "interleaved"


def test_every_service_has_its_own_log_key(bus: Bus, rig: str) -> None:
    sources: list[str] = []
    came = threading.Semaphore(0)
    with Bus.open(rig, name="recorder") as recorder:

        def take(sample: Any) -> None:
            sources.append(sample.source)
            came.release()

        recorder.subscribe_encoded(topics.LOG, take)
        recorder.declare_alive()
        wait_for(bus, "recorder")
        for service in ("grabber", "decoder"):
            bus.publish(LogLine(1, Level.INFO, "ready", service))
            assert came.acquire(timeout=90)
    assert sources == ["grabber", "decoder"]


def test_a_burst_of_small_messages_arrives_whole(rig: str) -> None:
    """A busy machine lets zenoh's sending thread wait: what is published meanwhile must queue, not vanish."""
    lines: list[int] = []
    last = threading.Event()
    burst = topics.LOG.depth

    def take(message: Message) -> None:
        assert isinstance(message, LogLine)
        lines.append(message.line)
        if message.line == burst - 1:
            last.set()

    with Bus.open(rig, name="writer") as writer, Bus.open(rig, name="reader") as reader:
        reader.subscribe(topics.LOG, take)
        reader.declare_alive()
        wait_for(writer, "reader")
        for line in range(burst):
            writer.publish(LogLine(1, Level.INFO, "x" * 200, "writer", line=line))
        assert last.wait(90)
    assert lines == list(range(burst))


def test_two_rigs_side_by_side_do_not_meet(bus: Bus, rig: str) -> None:
    ours, theirs = Collector(), Collector()
    with (
        Bus.open(rig, name="reader") as same,
        Bus.open(rig + "-b", name="writer") as other,
        Bus.open(rig + "-b", name="reader") as same_as_other,
    ):
        for reader, collector in ((same, ours), (same_as_other, theirs)):
            reader.subscribe(topics.FRAME, collector.take)
            reader.declare_alive()
        wait_for(bus, "reader")
        wait_for(other, "reader")
        for sequence in range(4):
            bus.publish(frame(bus, sequence))
            other.publish(frame(other, 100 + sequence))
            ours.wait(sequence)
            theirs.wait(100 + sequence)
    assert ours.sequences == [0, 1, 2, 3]
    assert theirs.sequences == [100, 101, 102, 103]


def test_processes_still_meet_when_the_first_are_gone(rig: str) -> None:
    """The first holds a meeting port; after it left, another one takes that over for those who come later."""
    collector = Collector()
    with Bus.open(rig, name="reader") as reader:
        with Bus.open(rig, name="first"), Bus.open(rig, name="second"):
            reader.subscribe(topics.FRAME, collector.take)
            reader.declare_alive()
        with Bus.open(rig, name="late") as late:
            wait_for(late, "reader")
            late.publish(frame(late, 1))
            collector.wait(1)


# ---------------------------------------------------------------- faults


def all_slots(bus: Bus) -> list[Any]:
    """Every slot of the frames' pool on loan, as soon as nobody else holds one any more."""
    deadline = time.monotonic() + 90
    loans: list[Any] = []
    while len(loans) < SLOTS - 1 and time.monotonic() < deadline:
        try:
            loans.append(bus.loan(topics.FRAME, SHAPE, np.uint8))
        except Exhausted:
            loans.clear()
            time.sleep(0.05)  # zenoh notices a dead or stopped holder by its missing heartbeat
    assert len(loans) == SLOTS - 1
    return loans


def test_a_killed_reader_does_not_leak_the_pool(rig: str) -> None:
    """Three readers are killed with frames in their hands; the writer still has all its slots afterwards."""
    with Bus.open(rig, name="writer") as bus:
        for _ in range(3):
            with Peer(hold_frames, rig) as holder:
                holder.hear()
                wait_for(bus, "holder")
                for sequence in range(20):
                    bus.publish(frame(bus, sequence))
                assert holder.ask("held?")[0]
                holder.kill()
        all_slots(bus)


def test_a_stopped_reader_knows_that_its_frames_are_void(rig: str) -> None:
    """A reader that was stopped loses what it holds: it must not compute with what stands there now."""
    with Bus.open(rig, name="writer") as bus, Peer(hold_frames, rig) as holder:
        holder.hear()
        wait_for(bus, "holder")
        for sequence in range(3):
            bus.publish(frame(bus, sequence))
        assert holder.ask("held?") == (True, [True] * 3)
        holder.signal(signal.SIGSTOP)
        for loan in all_slots(bus):
            loan[:] = 100
        holder.signal(signal.SIGCONT)
        intact, whole = holder.ask("held?")
        assert not intact
        assert not all(whole), "the writer never came round: the test shows nothing"


def test_a_reader_that_was_cut_off_comes_back(rig: str) -> None:
    with Bus.open(rig, name="writer") as bus, Peer(read_frames, rig, {}) as reader:
        reader.hear()
        wait_for(bus, "reader")
        bus.publish(frame(bus, 0))
        reader.ask(("until", 0))
        gone, back = threading.Event(), threading.Event()

        def see(name: str, is_there: bool) -> None:
            if gone.is_set() and is_there:
                back.set()
            elif not is_there:
                gone.set()

        bus.watch_alive(see)
        reader.signal(signal.SIGSTOP)
        assert gone.wait(90)
        reader.signal(signal.SIGCONT)
        assert back.wait(90)
        bus.publish(frame(bus, 1))
        sequences, broken, _ = reader.ask(("until", 1))
        assert sequences == [0, 1]
        assert broken == 0


def test_a_slow_reader_misses_and_counts_but_slows_nobody(rig: str) -> None:
    count = 60
    with Bus.open(rig, name="writer") as bus, Peer(read_frames, rig, {}, 0.05) as reader:
        reader.hear()
        wait_for(bus, "reader")
        bus.publish(frame(bus, 0))
        for sequence in range(1, count):
            bus.publish(frame(bus, sequence))
            time.sleep(1 / 180)
        assert bus.tally.dropped == {}
        sequences, broken, dropped = reader.ask(("until", count - 1))
        assert broken == 0
        assert sequences == sorted(sequences)
        assert 0 < len(sequences) < count
        assert dropped["frame:missed"] == sequences[-1] - sequences[0] + 1 - len(sequences)


def test_an_exhausted_pool_drops_and_counts(bus: Bus) -> None:
    loans = [bus.loan(topics.FRAME, SHAPE, np.uint8) for _ in range(SLOTS - 1)]
    with pytest.raises(Exhausted):  # noqa: PT012
        while True:
            loans.append(bus.loan(topics.FRAME, SHAPE, np.uint8))
    bus.publish(frame(bus, 1, loaned=False))
    assert bus.tally.dropped == {"frame:exhausted": 2}
    assert bus.tally.published == {}
    loans.clear()
    bus.publish(frame(bus, 2))
    assert bus.tally.published == {"frame": 1}


def test_malformed_messages_are_counted_named_once_and_dropped(
    bus: Bus, rig: str, caplog: pytest.LogCaptureFixture
) -> None:
    collector = Collector()
    with Bus.open(rig, name="reader") as reader:
        reader.subscribe(topics.FRAME, collector.take)
        reader.declare_alive()
        wait_for(bus, "reader")
        good = codec.encode(frame(bus, 1, loaned=False))
        for junk in (b"", b"\xff" * 100, good[:700], good[:-1]):
            bus._session.put(topics.FRAME.key(rig), junk)
        bus.publish(frame(bus, 9))
        collector.wait(9)
        assert reader.tally.dropped == {"frame:malformed": 4}
        assert [record.message for record in caplog.records if "malformed" in record.message] == [
            next(record.message for record in caplog.records if "frame" in record.message)
        ]


def test_a_handler_that_raises_goes_on_reading(bus: Bus, rig: str, caplog: pytest.LogCaptureFixture) -> None:
    collector = Collector()

    def take(message: Message) -> None:
        assert isinstance(message, Frame)
        if message.sequence == 1:
            raise RuntimeError("one")
        collector.take(message)

    with Bus.open(rig, name="reader") as reader:
        reader.subscribe(topics.FRAME, take)
        reader.declare_alive()
        wait_for(bus, "reader")
        for sequence in (1, 2):
            bus.publish(frame(bus, sequence))
        collector.wait(2)
        assert reader.tally.dropped == {"frame:failed": 1}
    assert "reading frame goes on" in caplog.text


@pytest.mark.skipif(os.geteuid() != 0, reason="gives up capabilities that only root has")
def test_too_little_lockable_memory_is_said_and_the_network_used(rig: str) -> None:
    with Bus.open(rig, name="writer") as bus, Peer(limited, rig) as reader:
        note = reader.hear()
        assert "may not lock 512 MB" in note
        assert "ulimit -l unlimited" in note
        wait_for(bus, "reader")
        for sequence in range(5):
            bus.publish(frame(bus, sequence))
            reader.ask(("until", sequence))
        assert reader.ask(("until", 4))[:2] == ([0, 1, 2, 3, 4], 0)


def test_nothing_is_left_in_shared_memory(rig: str) -> None:
    with Peer(read_frames, rig, {}) as reader, Peer(write_frames, rig) as writer:
        reader.hear()
        writer.hear()
        reader.ask(("until", 1))
        ours = writer.ask("segments?")
        assert len(ours) >= 3
        for peer in (writer, reader):
            peer.say("stop")
            assert peer.join() == 0
    if any(map(os.path.exists, ours)):
        # Who ends while another one just lets go of a segment leaves it, as a killed process does: to the next start.
        with Bus.open(rig, name="next"):
            pass
    assert [path for path in ours if os.path.exists(path)] == []


def test_what_a_killed_process_left_goes_with_the_next_start(rig: str) -> None:
    with Peer(read_frames, rig, {}) as reader, Peer(write_frames, rig) as writer:
        reader.hear()
        writer.hear()
        left = writer.ask("segments?")
        for peer in (writer, reader):
            peer.kill()
    assert all(os.path.exists(path) for path in left)
    with Peer(read_frames, rig, {}) as reader:
        reader.hear()
        assert [path for path in left if os.path.exists(path)] == []


def test_what_is_published_last_arrives(rig: str) -> None:
    """A writer that ends at once keeps its shared memory until its readers have what it published."""
    with Peer(read_frames, rig, {}, 0.01) as reader:
        reader.hear()
        for sequence in range(3):
            with Bus.open(rig, name="writer") as bus:
                wait_for(bus, "reader")
                bus.publish(frame(bus, sequence))
        sequences, broken, _ = reader.ask(("until", 2))
        assert sequences == [0, 1, 2]
        assert broken == 0


def test_a_pool_that_can_not_be_mapped_is_said(rig: str) -> None:
    """zenoh drops such frames without a word; the reader must not stand still without one."""
    with Bus.open(rig, name="reader") as bus, Peer(write_frames, rig) as writer:
        bus.declare_alive()
        writer.hear()
        for path in set(writer.ask("segments?")) - segments():
            os.unlink(path)
        bus.subscribe(topics.FRAME, lambda message: None)
        deadline = time.monotonic() + 90
        while not bus.note and time.monotonic() < deadline:
            time.sleep(0.01)
        assert "frame does not arrive: its shared memory can't be mapped here" in bus.note


# ---------------------------------------------------------------- ports


def test_a_foreign_program_on_one_meeting_port_does_not_matter() -> None:
    collector = Collector()
    with (
        taken_ports(1) as port,
        Bus.open("a", port=port) as writer,
        Bus.open("a", name="r", port=port) as reader,
    ):
        reader.subscribe(topics.FRAME, collector.take)
        reader.declare_alive()
        wait_for(writer, "r")
        writer.publish(frame(writer, 1))
        collector.wait(1)


def test_foreign_programs_on_all_meeting_ports_are_named() -> None:
    with taken_ports(16) as port, pytest.raises(UserError, match=rf"ports {port}\.\.{port + 15} are busy"):
        Bus.open("a", port=port)


def test_unknown_zenoh_settings_are_refused(rig: str) -> None:
    with pytest.raises(UserError, match="zenoh does not start"):
        Bus.open(rig, settings={"no/such/setting": 1})


# ---------------------------------------------------------------- commands


def test_a_command_is_answered(bus: Bus, rig: str) -> None:
    def handle(verb: str, parameters: Mapping[str, Any]) -> Mapping[str, Any]:
        if verb == "refuse":
            raise Refused("not now; stop first")
        return {"verb": verb, **parameters}

    bus.serve(handle)
    with Bus.open(rig, name="cli") as caller:
        assert caller.call("writer", "mode", {"name": "interleaved"}) == {
            "verb": "mode",
            "name": "interleaved",
        }
        with pytest.raises(Refused, match="not now; stop first"):
            caller.call("writer", "refuse")


def test_a_command_that_breaks_is_an_error_reply_and_the_next_one_works(bus: Bus, rig: str) -> None:
    def handle(verb: str, parameters: Mapping[str, Any]) -> Mapping[str, Any]:
        return {"half": 1 / parameters["by"]}

    bus.serve(handle)
    with Bus.open(rig, name="cli") as caller:
        with pytest.raises(Refused, match="division by zero"):
            caller.call("writer", "divide", {"by": 0})
        assert caller.call("writer", "divide", {"by": 2}) == {"half": 0.5}


def test_a_command_that_is_no_json_is_refused(bus: Bus, rig: str) -> None:
    bus.serve(lambda verb, parameters: {})
    with Bus.open(rig, name="cli") as caller:
        caller.call("writer", "known")
        for junk in (b"{", b"\xff\xfe", b"[1, 2]"):
            replies = list(caller._session.get(topics.control_key(rig, "writer", "x"), payload=junk))
            assert [reply.err is not None for reply in replies] == [True]
        assert caller.call("writer", "known") == {}


def test_a_command_to_nobody_says_so(bus: Bus) -> None:
    with pytest.raises(UserError, match="recorder does not answer"):
        bus.call("recorder", "start", timeout_s=0.3)


def test_who_is_there(bus: Bus, rig: str) -> None:
    seen: list[tuple[str, bool]] = []
    change = threading.Semaphore(0)

    def see(name: str, is_there: bool) -> None:
        seen.append((name, is_there))
        change.release()

    bus.watch_alive(see)
    with Bus.open(rig, name="decoder") as other:
        other.declare_alive()
        assert change.acquire(timeout=90)
        assert bus.alive() == {"decoder"}
    assert change.acquire(timeout=90)
    assert bus.alive() == set()
    assert seen == [("decoder", True), ("decoder", False)]
