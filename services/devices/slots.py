"""When which pattern is shown: the arithmetic that projector, camera and label share."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from endo3d_core.patterns import PatternSet, parse


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


def timeline(pattern_set: PatternSet | str, start_ns: int, exposure_us: float, dark_us: float) -> Timeline:
    """The timeline of a set; patterns with an exposure of their own keep it."""
    text = pattern_set if isinstance(pattern_set, str) else pattern_set.text
    exposures, offsets = _cycle(text, exposure_us, dark_us)
    return Timeline(start_ns, offsets, exposures)


@lru_cache(maxsize=16)
def _cycle(text: str, exposure_us: float, dark_us: float) -> tuple[tuple[float, ...], NDArray[np.int64]]:
    exposures = tuple(p.exposure_us or exposure_us for p in parse(text).patterns)
    periods_ns = np.rint((np.array(exposures) + dark_us) * 1e3).astype(np.int64)
    return exposures, np.concatenate(([0], np.cumsum(periods_ns)))
