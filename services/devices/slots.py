"""When which pattern of a set is shown: what projector, camera and label share."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from endo3d_core.patterns import PatternSet, parse
from endo3d_core.slot_identity import Timeline


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
