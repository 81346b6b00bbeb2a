"""Finding the lost camera again: a wide search against the map, a bounded part of it per cloud, then verification.

After an occlusion the tip has moved by millimetres; registration alone would slide into the nearest
position that looks alike. So first the predicted and the last pose are tried with gates that narrow in steps, which
bridges a gap of missed clouds. Then poses further and further around the last one are scored on a few map points,
geometry and texture together, so many per cloud that a search never holds up the clouds that follow, and only the
best is registered in earnest. What does not convince is refused.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from endo3d_core import health, rigid
from endo3d_core.compiled import kernel
from endo3d_core.live_view import LiveView
from endo3d_core.merging import CONFIRMED, COUNT
from endo3d_core.pooling import TEXTURE, Z
from endo3d_core.registration import Frame6, Linearisation, NormalEquations, Points, Scales, visible_surface

Array = NDArray[np.float64]

REACH = 0.35
"""How far the search goes to each side, in widths of the visible surface."""
STEP_CELLS = 2.5
"""Spacing of the tried positions in pooled cells: finer than the texture the head resolves."""
SCORED_POINTS = 800
SCORED_POSES = 200
"""Tried with one cloud."""
REGISTERED_POINTS = 3200
"""Map points that a pose is registered and verified with."""
WIDEST_CELLS = 6.0
GATES_CELLS = (WIDEST_CELLS, 3.0, 1.5, 1.0)
"""Gates of the registration from a candidate, widest first, in pooled cells."""
_STEPS_PER_GATE = 2
CONVINCING_SHARE, BELIEVABLE_SHARE = 0.6, 0.35
"""Of the visible map points that must agree: for a pose found by searching, and for a predicted one."""
CONVINCING_TEXTURE, BELIEVABLE_TEXTURE = 0.75, 0.6
"""Where there is texture: least slope of the cloud's over the map's; 1 is the same, a wrong place gives 0."""

NUDGE_CELLS = 5.0
"""How far a better start is looked for to each side."""
CLEARLY = 0.15
"""By so much in score (share in place times one plus correlation): several times what noise makes without texture."""
WORST_MISFIT, WORST_MISFIT_YOUNG = 4.0, 2.8
"""Of the differences in texture, in the cloud's own noise. To a young map 0.2 to 2.3 in place, simulated or decoded,
with texture or without, and 3.4 to 9 when a fifth of a millimetre off; to an old one, which has more detail, up to 3.8
in place."""


class World(Points, Protocol):
    """Map points to search in."""

    @property
    def used(self) -> int:
        """Rows from there on are empty."""


class Search:
    """One loss: where was looked already, and the map points to compare with (a lost camera adds none)."""

    def __init__(self, world: World, T_last: Array, view: LiveView, *, young: bool = False) -> None:
        """``young``: hardly a map point has been seen often, so all of them have to do."""
        frame = visible_surface(view.live)
        self._world = world
        self._T_last = T_last
        self._shifts = shifts(frame, view)
        self._levelling = np.eye(4)
        self._next = 0
        self._young = young
        self.rows = nearby(world, T_last, frame, 1 if young else CONFIRMED)

    def look(self, view: LiveView, starts: Iterable[Array], linearisation: Linearisation) -> Array | None:
        """The pose of ``view``: one of ``starts``, or one of the next ``SCORED_POSES``; None if none convinces."""
        if len(self.rows) < 100:
            return None
        frame = visible_surface(view.live)
        for start in starts:
            refined = self._refine(start, view, frame, linearisation)
            if refined is not None and convincing(refined[1], view.texture_noise, young=self._young):
                return refined[0]
        tried = self._shifts[self._next : self._next + SCORED_POSES]
        self._next = self._next + SCORED_POSES if self._next + SCORED_POSES < len(self._shifts) else 0
        poses = self._T_last @ tried @ self._levelling
        few = self.rows[:: max(len(self.rows) // SCORED_POINTS, 1)]
        found = scores(self._world.rows, few, view.live, view.coefficients, rigid.inverse(poses), 2.0 * view.pitch_mm)
        best = poses[np.argmax(found)]
        refined = self._refine(best, view, frame, linearisation)
        if refined is None:
            return None
        # What levels the best pose levels the next ones too: height and tilt change slowly.
        self._levelling = self._levelling @ rigid.inverse(best) @ refined[0]
        return refined[0] if convincing(refined[1], view.texture_noise, young=self._young) else None

    def _refine(
        self, T: Array, view: LiveView, frame: Frame6, linearisation: Linearisation
    ) -> tuple[Array, NormalEquations] | None:
        """Registration with gates that narrow; None when too few points are in place."""
        texture_scale = 0.2
        result = None
        for gate in GATES_CELLS:
            gate_mm = gate * view.pitch_mm
            for _ in range(_STEPS_PER_GATE):
                scales = Scales(gate_mm, gate_mm / 4.0, texture_scale, view.normal_rad)
                n = linearisation.at(T, self._world, self.rows, view.live, view.coefficients, frame, scales)
                if n.used < 30:
                    return None
                T = T @ health.motion(health.solve(n, max(view.sigma_mm, n.residual_mm)).step, frame)
                texture_scale = max(n.texture_residual, 1e-3)
                result = T, n
        return result


def convincing(n: NormalEquations, texture_noise: float = np.inf, *, young: bool = False) -> bool:
    """Enough points agree in place, and in texture, to believe a pose that nothing predicted.

    ``texture_noise`` is the cloud's own: a wrong place differs by the texture itself, even if the map is too ``young``
    to tell texture from noise.
    """
    worst = texture_noise * (WORST_MISFIT_YOUNG if young else WORST_MISFIT)
    return _agrees(n, CONVINCING_SHARE, CONVINCING_TEXTURE) and n.texture_misfit <= worst


def believable(n: NormalEquations) -> bool:
    """The same for a pose that was predicted well."""
    return _agrees(n, BELIEVABLE_SHARE, BELIEVABLE_TEXTURE)


def _agrees(n: NormalEquations, least_share: float, least_slope: float) -> bool:
    in_place = n.visible > 0 and n.used >= least_share * n.visible
    return in_place and not (n.textured_scene and n.texture_slope < least_slope)


def nearby(world: World, T_last: Array, frame: Frame6, at_least: int = CONFIRMED) -> NDArray[np.int32]:
    """At most ``REGISTERED_POINTS`` rows, evenly, of map points that the search could bring into view.

    Of those measured ``at_least`` so many times.
    """
    centre = rigid.apply(T_last, frame.centre)
    near = np.empty(world.used, np.int32)
    count = _near(world.rows, world.ints, world.used, at_least, centre, (2.0 + 2.0 * REACH) * frame.radius_mm, near)
    return near[:count][:: max(-(-count // REGISTERED_POINTS), 1)].copy()


@kernel
def _near(rows: Any, ints: Any, used: Any, at_least: Any, centre: Any, reach: Any, near: Any) -> Any:
    x, y, z, reach2 = np.float32(centre[0]), np.float32(centre[1]), np.float32(centre[2]), np.float32(reach * reach)
    count = 0
    for row in range(used):
        dx, dy, dz = rows[row, 0] - x, rows[row, 1] - y, rows[row, 2] - z
        if ints[row, COUNT] >= at_least and dx * dx + dy * dy + dz * dz < reach2:
            near[count] = row
            count += 1
    return count


def shifts(frame: Frame6, view: LiveView) -> Array:
    """(n, 4, 4) translations across the view, nearest first."""
    return _around(2.0 * REACH * frame.radius_mm, STEP_CELLS * view.pitch_mm)


def _around(reach_mm: float, step_mm: float) -> Array:
    """(n, 4, 4) translations along x and y, nearest first."""
    side = np.arange(0.0, reach_mm, step_mm)
    side = np.concatenate([-side[:0:-1], side])
    dx, dy = (d.ravel() for d in np.meshgrid(side, side))
    order = np.argsort(dx**2 + dy**2, kind="stable")
    out: Array = np.tile(np.eye(4), (len(order), 1, 1))
    out[:, 0, 3], out[:, 1, 3] = dx[order], dy[order]
    return out


def nudged(T: Array, world: Points, rows: NDArray[np.int32], view: LiveView) -> Array:
    """``T``, or the pose near by in which the cloud clearly looks more like the map: a bad prediction of a hand leads
    registration into the nearest detail that looks alike."""
    poses = T @ _around(NUDGE_CELLS * view.pitch_mm, view.pitch_mm)
    few = rows[:: max(len(rows) // SCORED_POINTS, 1)]
    found = scores(world.rows, few, view.live, view.coefficients, rigid.inverse(poses), WIDEST_CELLS * view.pitch_mm)
    best: Array = poses[np.argmax(found)]
    return best if found.max() > found[0] + CLEARLY else T


@kernel
def scores(map_rows: Any, chosen: Any, live: Any, coefficients: Any, poses: Any, gate: Any) -> Any:
    """poses (n, 4, 4) T_camera_world -> (n,): share of points in place, times agreement of their texture."""
    f = np.float32
    rows, columns = live.shape[1], live.shape[2]
    out = np.zeros(poses.shape[0])
    c, d = coefficients[0], coefficients[1]
    for k in range(poses.shape[0]):
        T = poses[k].astype(np.float32)
        seen = near = 0
        both = of_map = of_live = f(1e-9)
        for i in range(chosen.size):
            m = map_rows[chosen[i]]
            z = T[2, 0] * m[0] + T[2, 1] * m[1] + T[2, 2] * m[2] + T[2, 3]
            if not z > f(0.0):
                continue
            a = (T[0, 0] * m[0] + T[0, 1] * m[1] + T[0, 2] * m[2] + T[0, 3]) / z
            b = (T[1, 0] * m[0] + T[1, 1] * m[1] + T[1, 2] * m[2] + T[1, 3]) / z
            r2 = a * a + b * b
            u = c[0] + c[1] * a + c[2] * b + r2 * (c[3] * a + c[4] * b) + f(0.5)
            v = d[0] + d[1] * a + d[2] * b + r2 * (d[3] * a + d[4] * b) + f(0.5)
            if not (u > f(0.0) and v > f(0.0) and u < f(columns) and v < f(rows)):
                continue
            depth, texture = live[Z, int(v), int(u)], live[TEXTURE, int(v), int(u)]
            if np.isnan(depth):
                continue
            seen += 1
            if abs(depth - z) < gate:
                near += 1
                both += m[9] * texture
                of_map += m[9] * m[9]
                of_live += texture * texture
        if seen > chosen.size // 8:
            out[k] = near / seen * (f(1.0) + both / np.sqrt(of_map * of_live))
    return out
