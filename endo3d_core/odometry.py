"""Hand-guided odometry: predict, register against the map, merge (section 3.3)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from endo3d_core import health, rigid
from endo3d_core.live_view import POOL, LiveView
from endo3d_core.merging import SETTLED, MergedMap
from endo3d_core.recovery import WIDEST_CELLS, Search, believable, convincing, nearby, nudged
from endo3d_core.registration import Frame6, Linearisation, NormalEquations, Scales, visible_surface
from endo3d_core.submaps import Submaps

Array = NDArray[np.float64]

ITERATIONS = 4
_CONVERGED = 0.4
"""A step smaller than this, in point sigmas, ends the iteration: the next would be five times smaller."""
_COARSE = 4
"""The first iteration only has to take in what the prediction missed: every fourth map point does."""
_LEAST_POINTS = 300
_LEAST_SHARE = 0.04
"""Of the grid's cells that must be valid for a cloud to count."""
_WIDER_SHARE = 0.5
"""If fewer of the visible points agree at first, the prediction was worse than usual: look again with a wider gate."""
_STRAYED = 4.0
"""A last step larger than this, in point sigmas, has not converged: the result does not hold."""
_PATIENCE, _PATIENCE_YOUNG = 30, 5
"""Clouds that may fail to recover before a new submap begins; a map of few clouds is soon replaced."""
_LOOK_BACK = 8
"""Two of so many clouds are looked for in older submaps, the second to confirm the first."""
_LEAST_TEXTURE = 0.001
"""Relative brightness: far below any camera's noise, it keeps the robust scale from being zero."""
_LONGEST_GAP = 6.0
"""After a gap of more than so many periods the last velocity says nothing about a hand."""


class State(StrEnum):
    TRACKING = "tracking"
    DEGENERATE = "degenerate"
    LOST = "lost"
    RELOCALISED = "relocalised"


@dataclass(frozen=True, slots=True)
class Estimate:
    """One cloud's pose and how well it is known."""

    T_world_camera: Array
    information: Array
    """(6, 6) of (translation mm, rotation rad) in the camera's axes."""
    state: State
    sigma_weak_mm: float
    weak_direction: Array
    """(6,) unit vector: translation, and rotation scaled by the radius of the visible surface."""
    inlier_share: float
    residual_mm: float
    photometric_share: float
    submap: int


class Odometry:
    """Tracks clouds against the map they are merged into."""

    def __init__(self, merging_distance_mm: float = 0.075, capacity: int = 1_000_000) -> None:
        self.map = MergedMap(merging_distance_mm, capacity)
        self.view = LiveView()
        self.submaps = Submaps(capacity)
        self._equations = Linearisation()
        self.reset()

    def reset(self) -> None:
        """Empty map; the next cloud's camera is the world."""
        self.map.clear()
        self.T_world_camera = np.eye(4)
        self._velocity = np.zeros(6)
        self._last_ns: int | None = None
        self._period_ns = 0
        self._scale_mm = np.nan
        self._texture_scale = 0.1
        self._tilt_rad = 0.0
        self.submaps.clear()
        self.submap = self._begun = 0
        self._failures = 0
        self._unseen = False
        self._search: Search | None = None
        self._merged = 0
        self._visible = self.map.touched

    def track(self, channels: NDArray[np.float32], sequence: int, stamp_ns: int) -> Estimate:
        """One cloud (height, width, 6) float32: x y z mm, intensity, quality, sigma mm."""
        if self._load(channels) < max(_LEAST_POINTS, _LEAST_SHARE * channels.shape[0] * channels.shape[1] / POOL**2):
            self._unseen = self._last_ns is not None
            return self._lost()
        if self._last_ns is None:
            estimate = self._begin(stamp_ns)
            self._merge(sequence)
            return estimate
        known = None if self._failures else self._register(self._predict(stamp_ns), stamp_ns)
        if known is not None and self._unseen:
            known = replace(known, state=State.RELOCALISED)
        estimate = known or self._recover(stamp_ns)
        self._unseen = estimate.state is State.LOST
        if estimate.state is not State.LOST and estimate.state is not State.RELOCALISED:
            self._merge(sequence)
            if self._merged % _LOOK_BACK == 0:
                self.submaps.follow(self.T_world_camera, self.view)
            if len(self.submaps) and self._merged % _LOOK_BACK < 2:
                return self._look_back(estimate)
        return estimate

    def _look_back(self, estimate: Estimate) -> Estimate:
        """In an older submap, if the camera is back there."""
        found = self.submaps.look(self.T_world_camera, self.view, self._equations)
        if found is None:
            return estimate
        self.submaps.rejoin(found, self.map)
        self.submap, self.T_world_camera = found.submap.number, found.T_older_newer @ self.T_world_camera
        self._visible = nearby(self.map, self.T_world_camera, visible_surface(self.view.live))
        return replace(estimate, T_world_camera=self.T_world_camera, state=State.RELOCALISED, submap=self.submap)

    def _merge(self, sequence: int) -> None:
        self.map.merge(self.view.live, self.T_world_camera, sequence)
        self._visible = self.map.touched
        self._merged += 1

    def _forget(self) -> None:
        """A new submap begins; the way back into the old one stays open."""
        self.submaps.leave(self.submap, self.map)
        self.map.clear()

    def _load(self, channels: NDArray[np.float32]) -> int:
        """The number of pooled points; 0 also when nothing can be told from the cloud."""
        try:
            return self.view.load(channels)
        except ValueError:
            return 0

    def _begin(self, stamp_ns: int) -> Estimate:
        """The first cloud of a map defines where it is: nothing is uncertain yet."""
        self._last_ns = stamp_ns
        self._velocity[:] = 0.0
        self._period_ns, self._failures, self._merged, self._search = 0, 0, 0, None
        self._scale_mm = 2.0 * self.view.sigma_mm
        self._texture_scale, self._tilt_rad = 0.1, 0.0
        return Estimate(
            self.T_world_camera, np.diag(np.full(6, 1e12)), State.TRACKING, 0.0, np.zeros(6), 1.0, 0.0, 0.0, self.submap
        )

    def _is_stale(self, stamp_ns: int) -> bool:
        """The last pose is too old to say much about this one."""
        assert self._last_ns is not None
        gap_ns = stamp_ns - self._last_ns
        return gap_ns <= 0 or gap_ns > _LONGEST_GAP * self._period_ns > 0

    @property
    def _is_young(self) -> bool:
        """Hardly a point of the map has settled: its texture says nothing about its noise yet."""
        return self._merged < SETTLED

    def _predict(self, stamp_ns: int) -> Array:
        return self.T_world_camera if self._is_stale(stamp_ns) else self._extrapolated(stamp_ns)

    def _extrapolated(self, stamp_ns: int) -> Array:
        """At the velocity of the last pose, over the time since it."""
        assert self._last_ns is not None
        return self.T_world_camera @ rigid.exp(self._velocity * (stamp_ns - self._last_ns))

    def _recover(self, stamp_ns: int) -> Estimate:
        """A part of the search; a new submap when that keeps failing."""
        starts = [self.T_world_camera]
        if self._search is None:
            self._search = Search(self.map, self.T_world_camera, self.view, young=self._is_young)
            starts = [self._extrapolated(stamp_ns), self.T_world_camera]
        stale = self._is_stale(stamp_ns)
        T = self._search.look(self.view, starts, self._equations)
        if T is not None:
            self._visible = self._search.rows
            self._scale_mm, self._texture_scale = self.view.sigma_mm, 0.1
            estimate = self._register(T, stamp_ns)
            if estimate is not None:
                self._failures, self._search = 0, None
                if stale:  # the mean over a long gap says nothing about now
                    self._velocity[:] = 0.0
                return replace(estimate, state=State.RELOCALISED)
        self._failures += 1
        if self._failures > (_PATIENCE_YOUNG if self._is_young else _PATIENCE):
            self._forget()
            self._begun += 1
            self.submap = self._begun
            return self._begin(stamp_ns)
        return self._lost()

    def _register(self, predicted: Array, stamp_ns: int) -> Estimate | None:
        """Gauss-Newton from the predicted pose; None when the result does not hold."""
        view, sigma_mm = self.view, self.view.sigma_mm
        frame = visible_surface(view.live)
        T, rows = predicted, self._visible
        if self._is_young or self._is_stale(stamp_ns):
            T = nudged(predicted, self.map, rows, view)
        surprised_mm = float(np.linalg.norm(T[:3, 3] - predicted[:3, 3]))
        gate_mm = 8.0 * self._scale_mm + view.pitch_mm
        tilt_rad = max(self._tilt_rad, view.normal_rad)
        scales = Scales(gate_mm, 0.5 * gate_mm, 4.0 * self._texture_scale, tilt_rad)
        iterations, steps = ITERATIONS, 0
        while steps < iterations:
            chosen = rows if steps else rows[::_COARSE]
            n = self._equations.at(T, self.map, chosen, view.live, view.coefficients, frame, scales)
            if steps == 0 and n.used < _WIDER_SHARE * n.visible and gate_mm < WIDEST_CELLS * view.pitch_mm:
                gate_mm, iterations = WIDEST_CELLS * view.pitch_mm, 2 * ITERATIONS
                scales = Scales(gate_mm, 0.25 * gate_mm, 4.0 * self._texture_scale, tilt_rad)
                continue
            if n.used < (_LEAST_POINTS if steps else _LEAST_POINTS // _COARSE):
                return None
            solution = health.solve(n, sigma_mm)
            T = T @ health.motion(solution.step, frame)
            scale_mm = max(n.residual_mm, sigma_mm)
            self._tilt_rad = max(n.tilt_rad, view.normal_rad)
            texture_scale = max(n.texture_residual, _LEAST_TEXTURE)
            scales = Scales(8.0 * scale_mm, scale_mm, texture_scale, self._tilt_rad)
            steps += 1
            moved_mm = float(np.linalg.norm(solution.step))
            surprised_mm += moved_mm
            if steps > 1 and moved_mm < _CONVERGED * sigma_mm:
                break
        if surprised_mm > view.pitch_mm or self._is_stale(stamp_ns) or (self._is_young and solution.held.size):
            holds = convincing(n, view.texture_noise, young=self._is_young)
        else:
            holds = believable(n)
        if not holds or moved_mm > _STRAYED * scale_mm:
            return None
        self._scale_mm, self._texture_scale = min(scale_mm, 4.0 * sigma_mm), scales.texture
        self._advance(rigid.orthonormal(T), stamp_ns, solution.held, frame)
        return self._estimate(State.DEGENERATE if solution.held.size else State.TRACKING, n, solution, frame)

    def _estimate(self, state: State, n: NormalEquations, solution: health.Solution, frame: Frame6) -> Estimate:
        return Estimate(
            T_world_camera=self.T_world_camera,
            information=health.at_camera(solution.information, frame),
            state=state,
            sigma_weak_mm=solution.sigma_weak_mm,
            weak_direction=solution.weak_direction,
            inlier_share=n.used / max(n.visible, 1),
            residual_mm=n.residual_mm,
            photometric_share=solution.photometric_share,
            submap=self.submap,
        )

    def _lost(self) -> Estimate:
        """The last pose, and no information."""
        return Estimate(
            self.T_world_camera, np.zeros((6, 6)), State.LOST, np.inf, np.zeros(6), 0.0, np.nan, 0.0, self.submap
        )

    def _advance(self, T: Array, stamp_ns: int, held: Array, frame: Frame6) -> None:
        """The new pose, and the velocity for the next prediction: none along held directions."""
        assert self._last_ns is not None
        motion = rigid.inverse(self.T_world_camera) @ T
        if held.size:
            moved = health.scaled_twist(motion, frame)
            motion = health.motion(moved - held @ (held.T @ moved), frame)
        self._period_ns = max(stamp_ns - self._last_ns, 1)
        self._velocity = rigid.log(motion) / self._period_ns
        self.T_world_camera, self._last_ns = T, stamp_ns
