"""Is this a place that was seen before, and where exactly? Asked of one old keyframe, a little with every cloud.

The clouds are registered to what the keyframe keeps, as odometry registers them to its map, with gates that narrow
from cloud to cloud; when that does not convince, poses around are scored first. Several clouds have to agree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from endo3d_core import health, rigid
from endo3d_core.live_view import LiveView
from endo3d_core.map_rows import Rows
from endo3d_core.recovery import GATES_CELLS, REGISTERED_POINTS, SCORED_POINTS, convincing, scores, shifts
from endo3d_core.registration import Linearisation, NormalEquations, Scales, visible_surface

Array = NDArray[np.float64]

SCORED_POSES = 50
"""Tried with one cloud: half a millisecond."""
AGREEING = 3
"""Clouds that have to convince, one after the other."""
_LEAST_POINTS = 100
_STEPS = 2
_FIRST_TEXTURE = 0.2


@dataclass(frozen=True, slots=True)
class Found:
    """Where the camera was at the last cloud looked at, by the old part of the map."""

    T_world_camera: Array
    information: Array
    """(6, 6) of (translation mm, rotation rad) in the camera's axes."""


class LoopCheck:
    """Of keyframe ``candidate``, whose part of the map is ``rows``, in the world."""

    def __init__(self, candidate: int, rows: Rows, view: LiveView) -> None:
        self.candidate = candidate
        self.rows = np.ascontiguousarray(rows[:: max(-(-len(rows) // REGISTERED_POINTS), 1)])
        self.ints = self.rows.view(np.int32)
        self.over = len(self.rows) < _LEAST_POINTS
        self._all = np.arange(len(self.rows), dtype=np.int32)
        self._few = self._all[:: max(len(self._all) // SCORED_POINTS, 1)].copy()
        self._equations = Linearisation()
        self._shifts = shifts(visible_surface(view.live), view)
        self._tried, self._best_score = 0, 0.0
        self._searching = False
        self._begin(np.eye(4))

    def _begin(self, T_here_told: Array) -> None:
        """Registration anew from a pose off by this much from what odometry tells."""
        self._T_here_told = T_here_told
        self._gate, self._agreed = 0, 0
        self._texture = _FIRST_TEXTURE

    def look(self, view: LiveView, T_world_camera: Array) -> Found | None:
        """One cloud and where odometry says it was taken. ``over`` when there is nothing more to try."""
        if self._searching:
            self._score(view, T_world_camera)
            return None
        n, T, found = self._register(view, T_world_camera)
        if self._gate < len(GATES_CELLS) - 1 and n is not None:
            self._gate += 1
        elif n is None or not convincing(n):
            self._give_up()
        else:
            self._agreed += 1
            self.over = self._agreed >= AGREEING
        self._T_here_told = T @ rigid.inverse(T_world_camera)
        return found if self.over and self._agreed >= AGREEING else None

    def _give_up(self) -> None:
        """What odometry tells is too far off: search around it, once."""
        self.over = self._tried > 0
        self._searching = not self.over

    def _register(self, view: LiveView, told: Array) -> tuple[NormalEquations | None, Array, Found | None]:
        T = self._T_here_told @ told
        frame = visible_surface(view.live)
        gate_mm = GATES_CELLS[self._gate] * view.pitch_mm
        n, solution = None, None
        for _ in range(_STEPS):
            scales = Scales(gate_mm, gate_mm / 4.0, self._texture, view.normal_rad)
            n = self._equations.at(T, self, self._all, view.live, view.coefficients, frame, scales)
            if n.used < _LEAST_POINTS:
                return None, T, None
            solution = health.solve(n, max(view.sigma_mm, n.residual_mm))
            T = rigid.orthonormal(T @ health.motion(solution.step, frame))
            self._texture = max(n.texture_residual, 1e-3)
        assert solution is not None
        return n, T, Found(T, health.at_camera(solution.information, frame))

    def _score(self, view: LiveView, told: Array) -> None:
        """The next poses around; after the last, registration from the best."""
        tried = told @ self._shifts[self._tried : self._tried + SCORED_POSES]
        self._tried += len(tried)
        found = scores(self.rows, self._few, view.live, view.coefficients, rigid.inverse(tried), 2.0 * view.pitch_mm)
        best = int(np.argmax(found))
        if found[best] > self._best_score:
            self._best_score, self._T_best_told = float(found[best]), tried[best] @ rigid.inverse(told)
        if self._tried >= len(self._shifts):
            self._searching = False
            self.over = self._best_score == 0.0
            if not self.over:
                self._begin(self._T_best_told)
