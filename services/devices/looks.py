"""The distinct pictures of several pattern sets: what a projector has to hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from endo3d_core import patterns
from endo3d_core.patterns import Axis, Pattern, PatternSet


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """One picture."""

    image: NDArray[np.uint8]
    """(height, width), below 2^depth."""
    depth: int
    """Bits: 1 for a binary wave, else 8."""
    axis: Axis


@dataclass(frozen=True, slots=True)
class Looks:
    looks: tuple[Look, ...]
    members: tuple[tuple[int, ...], ...]
    """Per set, per slot: which look."""


def looks(sets: Sequence[PatternSet], width: int, height: int) -> Looks:
    """Patterns that differ in their exposure only look the same."""
    distinct: dict[Pattern, int] = {}
    found: list[Look] = []
    members = []
    for pattern_set in sets:
        of_set = []
        for pattern in pattern_set.patterns:
            bare = Pattern(pattern.frequency, pattern.shift_rad, pattern.axis, pattern.wave, pattern.gamma)
            if bare not in distinct:
                distinct[bare] = len(found)
                image = patterns.image(pattern, width, height)
                binary = pattern.wave == "binary"
                found.append(Look(image // np.uint8(255) if binary else image, 1 if binary else 8, pattern.axis))
            of_set.append(distinct[bare])
        members.append(tuple(of_set))
    return Looks(tuple(found), tuple(members))
