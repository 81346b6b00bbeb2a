"""Poses that don't belong: a board that moved, bent, or was found in the wrong place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from endo3d_core.calibrating.bundle import Size, Solution, solve
from endo3d_core.calibrating.sighting import Sighting

WORSE = 2.5
"""A pose is out when its error is so many times the median pose's."""
ALLOWED_SHARE = 1 / 3
"""Of the poses: if more of them disagree, it is not they that are wrong."""


@dataclass(frozen=True, slots=True)
class Solved:
    """What the poses that agree say."""

    solution: Solution
    kept: list[Sighting]
    rejected: dict[str, str]
    """Pose -> why."""


def solve_without_outliers(sightings: list[Sighting], camera_size: Size, projector_size: Size) -> Solved:
    """Drop the worst pose, solve again, as long as one stands out. Raises ``ValueError`` like ``solve``."""
    kept, rejected = list(sightings), dict[str, str]()
    while True:
        solution = solve(kept, camera_size, projector_size)
        errors = np.array([solution.pose_rms_px(index) for index in range(len(kept))])
        worst, usual = int(np.argmax(errors)), float(np.median(errors))
        full = len(rejected) + 1 > ALLOWED_SHARE * len(sightings) or len(kept) <= 3
        if errors[worst] <= WORSE * usual + 1e-6 or full:
            return Solved(solution, kept, rejected)
        pose = kept.pop(worst)
        rejected[pose.name] = f"its error of {errors[worst]:.2f} px is {errors[worst] / usual:.1f} times the usual one"
