"""Exposures find their slot whatever was lost on the way; what can't be known is said to be unknown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from endo3d_core.slot_identity import OFF_BEAT_MAX, UNKNOWN, SlotClock, Timeline

EVEN = (7471.0,) * 4
HDR = (10_200.0, 40_800.0, 163_200.0)
DARK_US = 105.0
START_NS = 1_700_000_000_000_000_000


def timeline(exposures_us: tuple[float, ...], start_ns: int = START_NS) -> Timeline:
    periods_ns = np.rint((np.array(exposures_us) + DARK_US) * 1e3).astype(np.int64)
    return Timeline(start_ns, np.concatenate(([0], np.cumsum(periods_ns))), exposures_us)


@dataclass(frozen=True)
class Camera:
    """Stamps as a camera gives them: its clock starts anywhere and runs at its own rate."""

    shift: float
    """Of its first stamp, in periods."""
    drift_ppm: float
    jitter: float
    """Greatest error of a stamp, in periods."""
    seed: int

    def stamps(self, shown: Timeline, counts: np.ndarray) -> list[int]:
        rng = np.random.default_rng(self.seed)
        period_ns = np.diff(shown.offsets_ns).min()
        true = np.array([shown.trigger_ns(int(count)) for count in counts]) - shown.start_ns
        off = self.shift * period_ns + true * self.drift_ppm * 1e-6
        off += rng.uniform(-self.jitter, self.jitter, len(counts)) * period_ns
        return [shown.start_ns + int(t) for t in true + np.rint(off)]


cameras = st.builds(
    Camera,
    shift=st.floats(-0.38, 0.38),
    drift_ppm=st.floats(-100, 100),
    jitter=st.floats(0, 0.08),
    seed=st.integers(0, 1 << 30),
)


def kept(rng_seed: int, loss: float, n: int) -> np.ndarray:
    """Counts of the exposures that happened: each trigger is missed with a probability, also in bursts."""
    rng = np.random.default_rng(rng_seed)
    there = rng.random(n) >= loss
    for start in rng.integers(0, n, 3):
        there[start : start + rng.integers(1, 30)] = False
    return np.flatnonzero(there)


@given(cameras, st.floats(0, 0.5), st.sampled_from([EVEN, HDR]))
@settings(max_examples=120, deadline=None)
def test_lost_triggers_never_lead_to_a_wrong_slot(camera: Camera, loss: float, exposures: tuple[float, ...]) -> None:
    shown = timeline(exposures)
    counts = kept(camera.seed, loss, 600)
    clock = SlotClock(shown)
    placed = [clock.place(stamp) for stamp in camera.stamps(shown, counts)]
    assert [each.count for each in placed] == counts.tolist()
    assert [each.slot for each in placed] == (counts % shown.slots).tolist()
    assert sum(each.missed for each in placed) == counts[-1] - counts[0] + 1 - len(counts)


@given(cameras, st.floats(0, 0.3))
@settings(max_examples=60, deadline=None)
def test_stamps_that_fit_no_slot_have_none(camera: Camera, share: float) -> None:
    """Late stamps, by a third of a period to two thirds: never a wrong slot, and the others keep theirs."""
    shown = timeline(EVEN)
    counts = kept(camera.seed, 0.1, 600)
    stamps = np.array(camera.stamps(shown, counts))
    rng = np.random.default_rng(camera.seed)
    late = rng.random(len(counts)) < share
    late[:1] = False
    late[3:] &= ~(late[2:-1] & late[1:-2] & late[:-3])  # no beat of their own
    stamps[late] += (rng.uniform(0.36, 0.64, late.sum()) * shown.offsets_ns[1]).astype(np.int64)
    clock = SlotClock(shown)
    for count, stamp, is_late in zip(counts, stamps, late, strict=True):
        placed = clock.place(int(stamp))
        assert placed.slot == (UNKNOWN if is_late else count % 4)
    assert clock.reanchored == 0


def test_a_late_stamp_is_no_missed_trigger() -> None:
    shown = timeline(EVEN)
    clock = SlotClock(shown)
    period = int(shown.offsets_ns[1])
    missed = [clock.place(shown.trigger_ns(count) + (period // 2 if count == 5 else 0)).missed for count in range(12)]
    assert missed == [0] * 12


@pytest.mark.parametrize("jump", [0.4, 0.5, 0.61, 7.5])
def test_a_clock_that_jumps_is_taken_up_within_four_exposures(jump: float) -> None:
    """A camera's clock reset, or the host's: the slots go on counting; the guess is counted, to be verified."""
    shown = timeline(EVEN)
    clock = SlotClock(shown)
    period = int(shown.offsets_ns[1])
    for count in range(10):
        clock.place(shown.trigger_ns(count))
    after = [clock.place(shown.trigger_ns(count) + int(jump * period)).slot for count in range(10, 20)]
    assert after[:OFF_BEAT_MAX] == [UNKNOWN] * OFF_BEAT_MAX
    assert UNKNOWN not in after[OFF_BEAT_MAX:]
    assert clock.reanchored == 1


def test_two_exposures_of_one_pattern_are_not_both_believed() -> None:
    shown = timeline(EVEN)
    clock = SlotClock(shown)
    slots = [clock.place(shown.trigger_ns(count)).slot for count in (0, 1, 2, 2, 3)]
    assert slots == [0, 1, 2, UNKNOWN, 3]


def test_the_timeline_finds_its_own_triggers() -> None:
    shown = timeline(HDR)
    for count in range(50):
        stamp = shown.trigger_ns(count)
        assert shown.nearest(stamp)[:2] == (count, 0)
        assert shown.last_begun(stamp) == count
        assert shown.last_begun(stamp - 1) == count - 1
