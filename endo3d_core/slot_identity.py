"""Which slot of a periodic sequence an exposure belongs to, from its time stamp.

A camera drops a trigger that comes before it is ready without a trace: its frame ids stay contiguous. Only the
stamps tell: the count of patterns advances by round(dt / T), and a stamp farther than a quarter of a period
from every slot has no known slot. Source: hardware notes of the IMX174 cameras (trigger overlap), section 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

TOLERANCE = 0.25
"""Of a period: |dt/T - round(dt/T)| beyond it names no slot."""
FOLLOW = 0.25
"""Share of a stamp's lateness that the clock follows: drift is followed, jitter is averaged."""
OFF_BEAT_MAX = 3
"""Exposures in a row off the beat, on a beat of their own: from the next one on that beat is taken."""
UNKNOWN = -1


@dataclass(frozen=True, eq=False)
class Timeline:
    """A periodic sequence of slots that began at ``start_ns``."""

    start_ns: int
    offsets_ns: NDArray[np.int64]
    """(slots + 1,) start of each slot within a cycle; the last is the cycle's length."""
    exposures_us: tuple[float, ...]

    @property
    def slots(self) -> int:
        return len(self.exposures_us)

    def trigger_ns(self, count: int) -> int:
        """When the exposure of the ``count``-th pattern since the start begins."""
        cycle, slot = divmod(count, self.slots)
        return self.start_ns + cycle * int(self.offsets_ns[-1]) + int(self.offsets_ns[slot])

    def nearest(self, stamp_ns: int) -> tuple[int, int, int]:
        """The pattern whose exposure begins nearest to a stamp: count, how late the stamp is, period (ns)."""
        cycle, rest = divmod(stamp_ns - self.start_ns, int(self.offsets_ns[-1]))
        slot = int(np.argmin(np.abs(self.offsets_ns - rest)))
        inside = min(slot, self.slots - 1)
        period_ns = int(self.offsets_ns[inside + 1] - self.offsets_ns[inside])
        return cycle * self.slots + slot, int(rest - self.offsets_ns[slot]), period_ns

    def last_begun(self, stamp_ns: int) -> int:
        """The pattern that is being shown at a stamp; negative before the start."""
        cycle, rest = divmod(stamp_ns - self.start_ns, int(self.offsets_ns[-1]))
        return cycle * self.slots + int(np.searchsorted(self.offsets_ns, rest, side="right")) - 1


@dataclass(frozen=True, slots=True)
class Placed:
    """Where an exposure stands in the sequence."""

    count: int
    """Patterns since the start; of an unknown slot that of the last known one."""
    slot: int
    """Index into the sequence, or ``UNKNOWN``."""
    missed: int
    """Patterns since the exposure before that made no frame."""


class SlotClock:
    """Places exposures in the order of their stamps, and follows the camera's clock against the projector's."""

    def __init__(self, timeline: Timeline) -> None:
        self.timeline = timeline
        self.delay_ns = 0.0
        """Camera stamps minus the timeline's."""
        self.reanchored = 0
        """How often a new beat was taken: the slots after it rest on the nearest guess, to be verified."""
        self._count = -1
        self._unplaced = 0
        """Exposures since the last one that was placed."""
        self._off_beat: list[int] = []

    def place(self, stamp_ns: int) -> Placed:
        """The place of the next exposure.

        The projector says to half a period when it started: the first exposure is that of the nearest slot, and
        how late it is the delay between the two clocks.
        """
        count, late, period_ns = self._nearest(stamp_ns)
        if self._count < 0:
            self.delay_ns, late = late * period_ns, 0.0
        elif abs(late) > TOLERANCE:
            self._off_beat = [*self._off_beat[-OFF_BEAT_MAX:], stamp_ns]
            if not self._own_beat():
                return self._nowhere()
            self.delay_ns += late * period_ns
            self.reanchored += 1
            late = 0.0
        if count <= self._count:  # two exposures of one pattern: one of the stamps is wrong
            return self._nowhere()
        missed = max(0, count - self._count - 1 - self._unplaced) if self._count >= 0 else 0
        self._count, self._unplaced = count, 0
        self._off_beat.clear()
        self.delay_ns += FOLLOW * late * period_ns
        return Placed(count, count % self.timeline.slots, missed)

    def _nowhere(self) -> Placed:
        self._unplaced += 1
        return Placed(self._count, UNKNOWN, 0)

    def _nearest(self, stamp_ns: int) -> tuple[int, float, int]:
        """Count, lateness in periods, period."""
        count, late_ns, period_ns = self.timeline.nearest(stamp_ns - round(self.delay_ns))
        return count, late_ns / period_ns, period_ns

    def _own_beat(self) -> bool:
        """Whether enough exposures in a row are off the beat by the same."""
        if len(self._off_beat) <= OFF_BEAT_MAX:
            return False
        lates = [self._nearest(stamp_ns)[1] for stamp_ns in self._off_beat]
        return all(abs(late - lates[-1] - round(late - lates[-1])) <= TOLERANCE / 2 for late in lates)
