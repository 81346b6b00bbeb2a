"""Finding the lost camera again: a wide search against the whole map, then a verified registration.

After an occlusion the tip has moved by millimetres; registration alone would slide into the nearest
position that looks alike. So poses around the last one are scored on a few map points, geometry and
texture together, and only the best are registered in earnest. What does not convince is refused.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d_core import health, rigid
from endo3d_core.compiled import kernel
from endo3d_core.live_view import LiveView
from endo3d_core.merging import MergedMap
from endo3d_core.registration import Frame6, Linearisation, NormalEquations, Scales, visible_surface

Array = NDArray[np.float64]

REACH = 0.35
"""How far the search goes to each side, in widths of the visible surface."""
STEP_CELLS = 2.5
"""Spacing of the tried positions in pooled cells: finer than the texture the head resolves."""
SCORED_POINTS = 1200
CANDIDATES = 6
GATES_CELLS = (6.0, 3.0, 1.5, 1.0)
"""Gates of the registration from a candidate, widest first, in pooled cells."""
CONVINCING_SHARE, BELIEVABLE_SHARE = 0.6, 0.35
"""Of the visible map points that must agree: for a pose found by searching, and for a predicted one."""
CONVINCING_TEXTURE, BELIEVABLE_TEXTURE = 0.75, 0.6
"""Where there is texture: least slope of the cloud's over the map's; 1 is the same, a wrong place gives 0."""


@dataclass(frozen=True, slots=True)
class Recovered:
    """A pose that convinced."""

    T_world_camera: Array
    equations: NormalEquations
    solution: health.Solution
    frame: Frame6
    visible: NDArray[np.int32]
    """Map rows to register the next cloud against."""


def recover(view: LiveView, world: MergedMap, T_last: Array, linearisation: Linearisation) -> Recovered | None:
    """The pose of ``view`` in ``world``, searched around ``T_last``; None when nothing convinces."""
    frame = visible_surface(view.live)
    rows = nearby(world, T_last, view, frame)
    if len(rows) < 100:
        return None
    poses = candidates(T_last, frame, view)
    few = rows[:: max(len(rows) // SCORED_POINTS, 1)]
    for _ in range(2):
        # The best pose so far levels the surface; the others are then tried at its height and tilt.
        scores = _scores(world.rows, few, view.live, view.coefficients, rigid.inverse(poses), 2.0 * view.pitch_mm)
        best = poses[np.argmax(scores)]
        levelled = _refine(best, rows[::4], view, world, frame, linearisation, GATES_CELLS[:2])
        poses = poses @ rigid.inverse(best) @ (levelled[0] if levelled else best)
    found = []
    for k in _peaks(poses, scores, 2.0 * STEP_CELLS * view.pitch_mm):
        refined = _refine(poses[k], rows, view, world, frame, linearisation, GATES_CELLS)
        if refined is not None and convincing(refined[1]):
            found.append(refined)
    if not found:
        return None
    T, n, solution = max(found, key=lambda f: f[1].used / (f[1].residual_mm * f[1].texture_residual))
    return Recovered(T, n, solution, frame, rows)


def convincing(n: NormalEquations) -> bool:
    """Enough points agree in place, and in texture if there is any, to believe a pose that nothing predicted."""
    return _agrees(n, CONVINCING_SHARE, CONVINCING_TEXTURE)


def believable(n: NormalEquations) -> bool:
    """The same for a pose that was predicted."""
    return _agrees(n, BELIEVABLE_SHARE, BELIEVABLE_TEXTURE)


def _agrees(n: NormalEquations, least_share: float, least_slope: float) -> bool:
    in_place = n.visible > 0 and n.used >= least_share * n.visible
    return in_place and not (n.textured_scene and n.texture_slope < least_slope)


def nearby(world: MergedMap, T_last: Array, view: LiveView, frame: Frame6) -> NDArray[np.int32]:
    """Rows of confirmed map points that the search could bring into view."""
    rows = world.confirmed()
    p = world.rows[rows, :3]
    centre = rigid.apply(T_last, frame.centre)
    reach_mm = (2.0 + 2.0 * REACH) * frame.radius_mm
    near: NDArray[np.int32] = rows[((p - centre.astype(np.float32)) ** 2).sum(axis=1) < reach_mm**2]
    return near


def candidates(T_last: Array, frame: Frame6, view: LiveView) -> Array:
    """(n, 4, 4) poses shifted across the view, nearest first."""
    reach_mm = 2.0 * REACH * frame.radius_mm
    side = np.arange(0.0, reach_mm, STEP_CELLS * view.pitch_mm)
    side = np.concatenate([-side[:0:-1], side])
    dx, dy = (d.ravel() for d in np.meshgrid(side, side))
    order = np.argsort(dx**2 + dy**2, kind="stable")
    shifts = np.tile(np.eye(4), (len(order), 1, 1))
    shifts[:, 0, 3], shifts[:, 1, 3] = dx[order], dy[order]
    return T_last @ shifts


def _peaks(poses: Array, scores: Array, apart_mm: float) -> list[int]:
    """Indices of the best scores that lie apart from better ones."""
    chosen: list[int] = []
    for k in np.argsort(-scores, kind="stable"):
        if all(np.linalg.norm(poses[k, :3, 3] - poses[c, :3, 3]) > apart_mm for c in chosen):
            chosen.append(int(k))
        if len(chosen) == CANDIDATES:
            break
    return chosen


def _refine(
    T: Array,
    rows: NDArray[np.int32],
    view: LiveView,
    world: MergedMap,
    frame: Frame6,
    linearisation: Linearisation,
    gates_cells: tuple[float, ...],
) -> tuple[Array, NormalEquations, health.Solution] | None:
    texture_scale = 0.2
    result = None
    for gate in gates_cells:
        gate_mm = gate * view.pitch_mm
        for _ in range(3):
            scales = Scales(gate_mm, gate_mm / 4.0, texture_scale, view.normal_rad)
            n = linearisation.at(T, world, rows, view.live, view.coefficients, frame, scales)
            if n.used < 30:
                return None
            solution = health.solve(n, max(view.sigma_mm, n.residual_mm))
            T = T @ health.motion(solution.step, frame)
            texture_scale = max(n.texture_residual, 1e-3)
            result = T, n, solution
    return result


@kernel
def _scores(map_rows: Any, chosen: Any, live: Any, coefficients: Any, poses: Any, gate: Any) -> Any:
    """poses (n, 4, 4) T_camera_world -> (n,): share of points in place, times agreement of their texture."""
    f = np.float32
    rows, columns = live.shape[0], live.shape[1]
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
            q = live[int(v), int(u)]
            if np.isnan(q[2]):
                continue
            seen += 1
            if abs(q[2] - z) < gate:
                near += 1
                both += m[9] * q[6]
                of_map += m[9] * m[9]
                of_live += q[6] * q[6]
        if seen > chosen.size // 8:
            out[k] = near / seen * (f(1.0) + both / np.sqrt(of_map * of_live))
    return out
