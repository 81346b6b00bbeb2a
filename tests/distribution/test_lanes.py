"""How messages cross: reduced, shared out, in order, and what waits where. No network, no time but what is given."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scans
from hypothesis import given
from hypothesis import strategies as st

from endo3d.schemas import codec, topics
from endo3d.schemas.messages import Cloud, DepthMap, Frame, MapDelta
from endo3d.schemas.wire import Malformed
from endo3d.services.lanes.clock import Exchange, Offset
from endo3d.services.lanes.incoming import Incoming
from endo3d.services.lanes.order import InOrder
from endo3d.services.lanes.outgoing import FORGOTTEN_S, UNDER_WAY, Every, Sender, newest_of
from endo3d.services.lanes.preview import MapChanges, packed_frame, thinned_cloud, thinned_depth, unpacked_frame
from endo3d.services.lanes.shards import Shares
from endo3d.services.runtime.service import Sample
from endo3d.services.runtime.tally import Tally
from endo3d_core.merging import MAP_POINT

LIMIT_S = 60.0


MESSAGES = {type(message): message for message in scans.messages(1)}
SMALL = np.zeros((2, 2), np.uint8)


def message_of(kind: type[Any]) -> Any:
    return MESSAGES[kind]


def frame_of(sequence: int, period: int = 4, pattern_set: str = "interleaved f1=15") -> Frame:
    slot = sequence % period
    return replace(MESSAGES[Frame], sequence=sequence, slot=slot, pattern_set=pattern_set, image=SMALL)


def sample_of(message: Any, valid: bool = True) -> Sample:
    return Sample(topics.of(message), "", memoryview(codec.encode(message)), 0, lambda: valid)


# ------------------------------------------------------------------- previews


@given(st.sampled_from([1, 2, 4]), st.sampled_from([np.uint8, np.uint16]))
def test_a_packed_frame_looks_the_same(step: int, dtype: type[np.generic]) -> None:
    v, u = np.mgrid[:96, :128]
    image = 120 + 60 * np.sin(u / 17) + 40 * np.cos(v / 13)
    scale = 1 if dtype is np.uint8 else 256
    frame = replace(message_of(Frame), image=(image * scale).astype(dtype), slot=2, epoch=7)
    seen = unpacked_frame(packed_frame(frame, step, 90))
    assert seen.image.shape == (96 // step, 128 // step)
    means = image[: 96 // step * step, : 128 // step * step].reshape(96 // step, step, 128 // step, step).mean((1, 3))
    assert np.abs(seen.image - means).max() < 6
    assert (seen.slot, seen.epoch, seen.stamp_ns) == (2, 7, frame.stamp_ns)


@given(st.binary(min_size=1, max_size=200))
def test_what_is_no_picture_is_malformed(raw: bytes) -> None:
    with pytest.raises(Malformed):
        unpacked_frame(replace(message_of(Frame), image=np.frombuffer(raw, np.uint8).reshape(1, -1)))


def test_a_thinned_cloud_keeps_points_and_says_so() -> None:
    cloud, depth = message_of(Cloud), message_of(DepthMap)
    thin = thinned_cloud(cloud, 3)
    assert thin.points.tobytes() == np.ascontiguousarray(cloud.points[::3, ::3]).tobytes()
    assert thin.valid_count == np.isfinite(cloud.points[::3, ::3]["z"]).sum()
    assert thin.grid_px == 3 * cloud.grid_px
    assert np.array_equal(thinned_depth(depth, 3).depth, depth.depth[::3, ::3])


KEYS = st.lists(st.integers(0, 5), max_size=6)


def delta_of(number: int, keys: list[int], removed: list[int], reset: bool) -> MapDelta:
    rows = np.zeros(len(set(keys)), MAP_POINT)
    rows["kx"], rows["x"] = sorted(set(keys)), number
    gone = np.array([[key, 0, 0] for key in removed], np.int16).reshape(-1, 3)
    return replace(message_of(MapDelta), points=rows, removed=gone, revision=number, reset=reset)


def apply(deltas: list[MapDelta]) -> dict[int, float]:
    """The map by the contract: a reset empties it, then voxels go, then voxels are set."""
    known: dict[int, float] = {}
    for delta in deltas:
        if delta.reset:
            known.clear()
        for key in delta.removed:
            known.pop(int(key[0]), None)
        known |= {int(row["kx"]): float(row["x"]) for row in delta.points}
    return known


@given(st.lists(st.tuples(KEYS, KEYS, st.booleans(), st.booleans()), max_size=8))
def test_gathered_changes_have_the_same_effect(steps: list[tuple[list[int], list[int], bool, bool]]) -> None:
    """Sent at any of the times, the deltas that cross build the same map."""
    changes, all_of_them, crossed = MapChanges(), [], []
    for number, (keys, removed, reset, send) in enumerate(steps):
        delta = delta_of(number, keys, removed, reset)
        all_of_them.append(delta)
        changes.add(delta)
        if send:
            crossed.append(changes.take())
    crossed.append(changes.take())
    arrived = [delta for delta in crossed if delta is not None]
    assert apply(arrived) == apply(all_of_them)
    assert [delta.revision for delta in arrived] == list(range(1, len(arrived) + 1))


# ------------------------------------------------------------------- shared decoding


class ActingDecoder:
    """The stock decoder's rule: a gap starts a new window; a window of ``reach + 1`` frames gives its centre."""

    def __init__(self, reach: int, latency: int) -> None:
        self.reach, self.latency = reach, latency
        self.window: list[int] = []

    def take(self, sequence: int) -> list[int]:
        if self.window and sequence != self.window[-1] + 1:
            self.window = []
        self.window = [*self.window[-self.reach :], sequence] if self.reach else [sequence]
        return [sequence - self.latency] if len(self.window) == self.reach + 1 else []


def decode(frames: int, hosts: int, piece: int, lost_at: int | None, start: int = 0) -> tuple[list[int], list[int]]:
    """Sequences given on, and those that a single decoder would have given; one host is lost at a frame."""
    names = [f"host{number}" for number in range(hosts)]
    there = set(names)
    shares = Shares(names, there.__contains__, piece)
    decoders = {name: ActingDecoder(6, 3) for name in names}
    whole, order = ActingDecoder(6, 3), InOrder()
    given_on: list[int] = []
    expected: list[int] = []
    period_ns = 6_000_000
    for sequence in range(start, start + frames):
        if sequence == lost_at:
            there.discard("host0")
        expected += whole.take(sequence)
        frame = frame_of(sequence)
        for name in names:
            if shares.takes(name, frame) and name in there:
                for centre in decoders[name].take(sequence):
                    cloud = replace(message_of(Cloud), sequence=centre)
                    given_on += [result.sequence for result in order.add(cloud, sequence * period_ns)]
    given_on += [result.sequence for result in order.due((start + frames) * period_ns + 10**12)]
    return given_on, expected


@given(st.integers(60, 150), st.integers(1, 3), st.integers(4, 50), st.integers(0, 1000))
def test_shared_decoding_gives_what_one_decoder_gives(frames: int, hosts: int, piece: int, start: int) -> None:
    given_on, expected = decode(frames, hosts, piece, None, start - start % 4)
    assert given_on == expected


@given(st.integers(70, 130), st.sampled_from([12, 24, 48]))
def test_a_lost_decoder_costs_its_windows(lost_at: int, piece: int) -> None:
    given_on, expected = decode(260, 2, piece, lost_at)
    assert given_on == sorted(set(given_on))
    missing = sorted(set(expected) - set(given_on))
    assert len(missing) <= 2 * piece + 12
    assert all(lost_at - piece - 12 <= sequence <= lost_at + 2 * piece + 12 for sequence in missing)


def test_sequences_of_patterns_stay_whole() -> None:
    pattern_set = "conventional f=50/49/43 steps=4/2/2"
    shares = Shares(["a", "b"], lambda host: True, 16)
    owners = [[host for host in "ab" if shares.takes(host, frame_of(k, 8, pattern_set))] for k in range(64)]
    assert all(len(owner) == 1 for owner in owners), "no frame twice"
    assert all(owners[8 * k : 8 * k + 8] == [owners[8 * k]] * 8 for k in range(8))
    assert {owner[0] for owner in owners} == {"a", "b"}


@given(st.permutations(range(12)))
def test_any_order_within_the_wait_comes_out_sorted(order: list[int]) -> None:
    """Once the first is known; what is not lost is not skipped."""
    merged = InOrder(hold_ns=1_000)
    out = [r.sequence for s in (-2, -1) for r in merged.add(replace(message_of(Cloud), sequence=s + 2), 0)]
    for sequence in order:
        out += [r.sequence for r in merged.add(replace(message_of(Cloud), sequence=sequence + 2), 500)]
    assert out == list(range(14))
    assert merged.late == 0


def test_what_is_lost_is_waited_for_once() -> None:
    merged = InOrder(hold_ns=100)
    cloud = message_of(Cloud)
    out = []
    for sequence, now_ns in [(0, 0), (1, 10), (3, 20), (4, 30)]:
        out += [r.sequence for r in merged.add(replace(cloud, sequence=sequence), now_ns)]
    assert out == [0, 1], "2 may still come"
    assert [r.sequence for r in merged.due(119)] == []
    assert [r.sequence for r in merged.due(120)] == [3, 4]
    assert list(merged.add(replace(cloud, sequence=2), 130)) == []
    assert merged.late == 1


# ------------------------------------------------------------------- the way out and in


class Link:
    """A link that takes one payload whenever it is let."""

    def __init__(self) -> None:
        self.carried: list[bytes] = []
        self._let = threading.Semaphore(0)
        self._came = threading.Condition()

    def put(self, payload: bytes) -> None:
        assert self._let.acquire(timeout=LIMIT_S)
        with self._came:
            self.carried.append(payload)
            self._came.notify_all()

    def let(self, count: int, wait_for: int) -> None:
        for _ in range(count):
            self._let.release()
        with self._came:
            assert self._came.wait_for(lambda: len(self.carried) >= wait_for, LIMIT_S)


def test_a_stalled_link_keeps_nothing_of_the_rig_and_forgets_the_oldest() -> None:
    poses = [message for message in scans.messages(20) if topics.of(message) == topics.POSE]
    link = Link()
    waiting = Every(5, lambda sample: bytes(sample.payload))
    sender = Sender(topics.POSE, waiting, link.put)
    for pose in poses:
        sender.add(sample_of(pose))  # returns at once, whatever the link does
    assert waiting.lost == 15
    sender.start()
    link.let(5, 5)
    sender.close()
    assert [codec.decode(topics.POSE, payload).sequence for payload in link.carried] == [15, 16, 17, 18, 19]


def test_the_newest_waits_and_what_was_taken_back_does_not_cross() -> None:
    waiting = newest_of(topics.FRAME, None)
    waiting.add(sample_of(frame_of(1), valid=False))
    assert not waiting.ready()
    waiting.add(sample_of(frame_of(2)))
    waiting.add(sample_of(frame_of(3)))
    payload = waiting.take()
    assert payload is not None
    assert codec.decode(topics.FRAME, payload).sequence == 2
    assert waiting.take() is None


def test_no_more_is_under_way_than_the_far_host_has_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("endo3d.services.lanes.outgoing.FORGOTTEN_S", 1e6)
    assert FORGOTTEN_S < 10
    carried: list[bytes] = []
    enough = threading.Semaphore(0)

    def put(payload: bytes) -> None:
        carried.append(payload)
        enough.release()

    waiting = Every(50, lambda sample: bytes(sample.payload))
    sender = Sender(topics.FRAME, waiting, put)
    for sequence in range(10):
        sender.add(sample_of(frame_of(sequence)))
    sender.start()
    for _ in range(UNDER_WAY):
        assert enough.acquire(timeout=LIMIT_S)
    assert not enough.acquire(timeout=0.1)
    sender.taken()
    assert enough.acquire(timeout=LIMIT_S)
    assert len(carried) == UNDER_WAY + 1
    sender.close()


@given(st.binary(max_size=300), st.sampled_from(topics.TOPICS), st.booleans())
def test_hostile_bytes_are_counted_and_dropped(raw: bytes, topic: topics.Topic, packed: bool) -> None:
    published: list[Any] = []
    tally = Tally()
    incoming = Incoming(topic, published.append, tally, speaks_for={"decoder"}, packed=packed)
    taken: list[bool] = []
    incoming.taken = lambda: taken.append(True)
    incoming.take(Sample(topic, "", memoryview(raw), 0))
    assert len(published) + sum(tally.snapshot()[2].values()) == 1
    assert taken == [True]


# ------------------------------------------------------------------- clocks


@given(st.integers(-(10**12), 10**12), st.lists(st.tuples(st.integers(0, 10**8), st.integers(0, 10**8)), min_size=1))
def test_an_offset_is_known_to_half_the_quickest_round_trip(offset_ns: int, ways: list[tuple[int, int]]) -> None:
    offset, now_ns = Offset(), 10**15
    for there_ns, back_ns in ways[-60:]:
        offset.add(Exchange(now_ns, now_ns + there_ns + offset_ns, now_ns + there_ns + back_ns))
        now_ns += 10**9
    assert offset.best is not None
    assert abs(offset.offset_ns - offset_ns) <= offset.best.round_trip_ns // 2 + 1
    assert offset.best.round_trip_ns == min(there + back for there, back in ways[-60:])

