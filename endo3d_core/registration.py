"""Projective registration of a cloud to the visible part of the merged map (sections 3.3 and 5 of the paper).

Map points are projected into the organised grid, which replaces the closest-point search of ICP. Rows are
point-to-plane, weighted by variance, by observation count and robustly. Photometric rows compare the texture; they
are meant for directions in which the geometry is weak (``health`` decides).

The unknown is a small motion of the camera in its own axes, about the centre of the visible surface, with the
rotation scaled by the surface's radius: all six numbers are mm and comparable.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from endo3d_core import rigid
from endo3d_core.compiled import kernel
from endo3d_core.merging import COUNT

Array = NDArray[np.float64]

SAME_SURFACE = 0.8
"""Least cosine between the normals of a pair (37 deg)."""
GRAZING = 0.3
"""Least cosine between normal and view: beyond, a ray's noise is mostly along the surface."""
FACING = 0.9
"""Least view cosine of a photometric row: on flanks, shading changes with the pose."""

_TILT_STRIDE = 8
_SHARED = 2.0
"""Neighbouring cells share pixels of their gradients: so many points of a voxel count as one independent."""
SETTLED = 16
"""Measured points from which on a map point's texture is compared as a whole: its noise is a quarter of one's."""

_AVERAGED = 25.0
"""Averaging makes normals at most so many times less noisy (in variance): ripple of the decoder is no white noise."""

_SURFACE_ROWS = 12
"""J (6), distance, then 1 and the scaled position (3) weighted with the noise of the normal, and one minus the cosine
between the normals."""
_TEXTURE_ROWS = 13
"""J with the map's gradient (6), with the cloud's (6), difference."""


@dataclass(frozen=True, slots=True)
class Frame6:
    """What a small motion is expressed in."""

    centre: Array
    """(3,) mm in camera axes: what rotations are about."""
    radius_mm: float
    """What turns radians into mm: the rms radius of the visible surface."""


@dataclass(frozen=True, slots=True)
class Scales:
    """What counts as near, in this iteration."""

    gate_mm: float
    """Farther points are no pairs."""
    distance_mm: float
    """Robust scale of distances."""
    texture: float
    """Robust scale of differences in texture."""
    normal_rad: float
    """1-sigma tilt of one cloud's normals, about each axis."""


@dataclass(frozen=True, slots=True)
class NormalEquations:
    """Information, gradient and what the rows were like. Matrices are (6, 6), gradients (6,)."""

    geometry: Array
    geometry_gradient: Array
    geometry_noise: Array
    """The part of ``geometry`` that noisy normals alone would make."""
    texture: Array
    """Of the photometric rows, without what grey noise alone would make."""
    texture_gradient: Array
    texture_live: Array
    """Of the cloud's own texture gradients: more than ``texture`` by one cloud's noise."""
    visible: int
    """Map points that fall onto valid cells."""
    used: int
    textured: int
    residual_mm: float
    """Robust rms of the distances."""
    tilt_rad: float
    """Typical angle about one axis between normals of map and cloud: their noise."""
    texture_residual: float
    """The same of the differences in texture, at the cloud's typical brightness."""
    texture_slope: float
    """Of the cloud's texture over the map's: 1 where they match, 0 at a wrong place."""
    texture_rms: float
    """Of the map's texture: its contrast."""

    @property
    def textured_scene(self) -> bool:
        """The map's texture stands out of the differences: more than noise averaged over ``SETTLED`` points."""
        return self.texture_rms > 0.5 * self.texture_residual


def visible_surface(live: NDArray[np.float32], stride: int = 8) -> Frame6:
    """Centre and rms radius of the points of live (rows, columns, LIVE)."""
    points = live[::stride, ::stride, :3].reshape(-1, 3)
    points = points[np.isfinite(points[:, 2])].astype(np.float64)
    centre = points.mean(axis=0)
    return Frame6(centre, float(np.sqrt(((points - centre) ** 2).sum(axis=1).mean())))


class Points(Protocol):
    """Map points to register to: a merged map, or a part of an old one."""

    rows: NDArray[np.float32]
    """(n, ROW), as ``merging`` lays them out."""
    ints: NDArray[np.int32]
    """The same bytes."""


class Linearisation:
    """Builds normal equations at a pose; owns the rows."""

    def __init__(self) -> None:
        self._surface = np.empty((_SURFACE_ROWS, 0), np.float32)
        self._texture = np.empty((_TEXTURE_ROWS, 0), np.float32)

    def at(
        self,
        T_world_camera: Array,
        world: Points,
        chosen: NDArray[np.int32],
        live: NDArray[np.float32],
        coefficients: NDArray[np.float32],
        frame: Frame6,
        scales: Scales,
    ) -> NormalEquations:
        """Of the map's rows ``chosen`` against ``live`` (rows, columns, LIVE) with its grid's rays (2, 5)."""
        if self._surface.shape[1] < len(chosen):
            self._surface = np.empty((_SURFACE_ROWS, len(chosen)), np.float32)
            self._texture = np.empty((_TEXTURE_ROWS, len(chosen)), np.float32)
        counts, sums = _rows(
            world.rows, world.ints, chosen, live, coefficients, rigid.inverse(T_world_camera),
            frame.centre, frame.radius_mm, scales.gate_mm, scales.distance_mm, scales.texture, scales.normal_rad,
            self._surface, self._texture,
        )  # fmt: skip
        visible, used, textured, settled = counts
        squares, weights, texture_squares, texture_weights, of_map, of_both, inverse_counts = sums
        surface = _gram(self._surface[:7], used)
        tilted = _gram(self._surface[7:11], used)
        texture = _gram(self._texture, textured)
        geometry = surface[:6, :6]
        tilt_variance = tilted[0, 0] / max(np.trace(geometry[:3, :3]), 1e-300)
        return NormalEquations(
            geometry=geometry,
            geometry_gradient=-surface[:6, 6],
            geometry_noise=_any_normal(tilted) - tilt_variance * geometry,
            texture=_signal(texture, textured / max(_SHARED * inverse_counts, 1e-30)),
            texture_gradient=-texture[:6, 12],
            texture_live=texture[6:12, 6:12],
            visible=visible,
            used=used,
            textured=textured,
            residual_mm=float(np.sqrt(squares / max(weights, 1e-30))),
            tilt_rad=float(np.sqrt(np.median(self._surface[11, :used:_TILT_STRIDE]) / np.log(2.0))) if used else 0.0,
            texture_residual=float(np.sqrt(texture_squares / max(texture_weights, 1e-30))),
            texture_slope=of_both / max(of_map, 1e-30),
            texture_rms=float(np.sqrt(of_map / max(settled, 1))),
        )


def _signal(texture: Array, count: float) -> Array:
    """(6, 6) information of the texture's true gradients, from the Gram matrix (13, 13) of the photometric rows.

    Cloud and map have the same signal S; one has the noise N, the other, averaged over ``count`` points, N / count.
    Solved for S this holds at a wrong pose too. A map of one cloud tells nothing about N: then it is what the
    gradients of both, with their independent noise, have in common.
    """
    of_map, of_live, common = texture[:6, :6], texture[6:12, 6:12], texture[:6, 6:12]
    if count < 2.0:
        both: Array = 0.5 * (common + common.T)
        return both
    signal: Array = (of_map - of_live / count) / (1.0 - 1.0 / count)
    return signal


def _any_normal(tilted: Array) -> Array:
    """(6, 6) information of normals that point anywhere, from the sums (4, 4) of w (1, s)(1, s)^T."""
    S = tilted[1:, 1:]
    M = np.zeros((6, 6))
    M[:3, :3] = tilted[0, 0] * np.eye(3)
    M[3:, :3] = rigid.skew(tilted[0, 1:])
    M[:3, 3:] = M[3:, :3].T
    M[3:, 3:] = np.trace(S) * np.eye(3) - S
    return M


@kernel
def _gram(rows: NDArray[np.float32], count: int) -> Array:
    """(n, >= count) float32 -> (n, n) float64: the products of all pairs of rows."""
    n = rows.shape[0]
    out = np.empty((n, n))
    for i in range(n):
        a = rows[i]
        for j in range(i + 1):
            b = rows[j]
            total: Any = np.float32(0.0)
            for k in range(count):
                total += a[k] * b[k]
            out[i, j] = out[j, i] = total
    return out


@kernel
def _rows(
    map_rows: Any, map_ints: Any, chosen: Any, live: Any, coefficients: Any, T_camera_world: Any,
    centre: Any, radius: Any, gate: Any, scale: Any, texture_scale: Any, normal_sigma: Any,
    surface: Any, textured: Any,
) -> Any:  # fmt: skip
    """Fills surface (11, n) and textured (13, n) with weighted rows; returns counts and robust sums of squares."""
    f = np.float32
    T = T_camera_world
    r00, r01, r02, tx = f(T[0, 0]), f(T[0, 1]), f(T[0, 2]), f(T[0, 3])
    r10, r11, r12, ty = f(T[1, 0]), f(T[1, 1]), f(T[1, 2]), f(T[1, 3])
    r20, r21, r22, tz = f(T[2, 0]), f(T[2, 1]), f(T[2, 2]), f(T[2, 3])
    c0, c1, c2, c3, c4 = (
        coefficients[0, 0],
        coefficients[0, 1],
        coefficients[0, 2],
        coefficients[0, 3],
        coefficients[0, 4],
    )
    d0, d1, d2, d3, d4 = (
        coefficients[1, 0],
        coefficients[1, 1],
        coefficients[1, 2],
        coefficients[1, 3],
        coefficients[1, 4],
    )
    gx, gy, gz, per_radius = f(centre[0]), f(centre[1]), f(centre[2]), f(1.0 / radius)
    zero, half, one, three = f(0.0), f(0.5), f(1.0), f(3.0)
    per_scale2, gate32 = f(0.25 / (scale * scale)), f(gate)
    per_texture2 = f(1.0 / (texture_scale * texture_scale))
    tilt_scale = f(normal_sigma)
    rows, columns = live.shape[0], live.shape[1]
    visible = used = texture_used = settled = 0
    squares = weights = texture_squares = texture_weights = of_map = of_both = 0.0
    inverse_counts: Any = 0.0
    for i in range(chosen.size):
        m = map_rows[chosen[i]]
        x = r00 * m[0] + r01 * m[1] + r02 * m[2] + tx
        y = r10 * m[0] + r11 * m[1] + r12 * m[2] + ty
        z = r20 * m[0] + r21 * m[1] + r22 * m[2] + tz
        if not z > zero:
            continue
        per_z = one / z
        a, b = x * per_z, y * per_z
        r2 = a * a + b * b
        u = c0 + c1 * a + c2 * b + r2 * (c3 * a + c4 * b)
        v = d0 + d1 * a + d2 * b + r2 * (d3 * a + d4 * b)
        if not (u > -half and v > -half):
            continue
        column, row = int(u + half), int(v + half)
        if column >= columns or row >= rows:
            continue
        q = live[row, column]
        if np.isnan(q[3]):
            continue
        visible += 1
        nx = r00 * m[3] + r01 * m[4] + r02 * m[5]
        ny = r10 * m[3] + r11 * m[4] + r12 * m[5]
        nz = r20 * m[3] + r21 * m[4] + r22 * m[5]
        cosine = nx * q[3] + ny * q[4] + nz * q[5]
        if cosine < f(SAME_SURFACE):
            continue
        facing = -(nx * a + ny * b + nz) / np.sqrt(one + r2)
        if facing < f(GRAZING):
            continue
        # Where the map point's own ray meets the live tangent plane: a pair without a tangential offset, which
        # the noise of the map's normals would turn into a pull towards whole cells.
        ahead = (q[3] * q[0] + q[4] * q[1] + q[5] * q[2]) / (q[3] * x + q[4] * y + q[5] * z)
        residual = (nx * x + ny * y + nz * z) * (ahead - one)
        if not abs(residual) <= gate32:
            continue
        # The variance along the normal is the live point's, times 1 + 1/count for the map point's.
        count = f(map_ints[chosen[i], COUNT])
        trust = count / (count + one)
        robust = one / (one + residual * residual * per_scale2)
        robust *= robust
        squares += robust * residual * residual
        weights += robust
        w = np.sqrt(robust * trust * q[10]) / facing
        sx, sy, sz = (q[0] - gx) * per_radius, (q[1] - gy) * per_radius, (q[2] - gz) * per_radius
        surface[0, used], surface[1, used], surface[2, used] = w * nx, w * ny, w * nz
        surface[3, used] = w * (sy * nz - sz * ny)
        surface[4, used] = w * (sz * nx - sx * nz)
        surface[5, used] = w * (sx * ny - sy * nx)
        surface[6, used] = w * residual
        tilt = w * tilt_scale / np.sqrt(min(count, f(_AVERAGED)))
        surface[7, used], surface[8, used], surface[9, used], surface[10, used] = tilt, tilt * sx, tilt * sy, tilt * sz
        surface[11, used] = max(one - cosine, zero)  # rounding may carry a cosine past one
        used += 1
        if not (facing >= f(FACING) and q[7] == q[7]):
            continue
        # The live texture where the map point falls: bilinear, from the offset to this cell's own ray.
        fx, fy = c1 + c3 * (three * a * a + b * b), d2 + d4 * (a * a + three * b * b)
        du, dv = fx * (a - q[0] / q[2]), fy * (b - q[1] / q[2])
        aside, below = column + (1 if du > zero else -1), row + (1 if dv > zero else -1)
        du, dv = abs(du), abs(dv)
        here = (one - du) * q[6] + du * live[row, aside, 6]
        there = (one - du) * live[below, column, 6] + du * live[below, aside, 6]
        texture: Any = (one - dv) * here + dv * there
        difference = texture - m[9]
        squared = difference * difference * q[12]
        if not squared < one:
            continue
        inverse_counts += one / count
        if count >= f(SETTLED):
            of_map += m[9] * m[9]
            of_both += m[9] * texture
            settled += 1
        robust = one / (one + f(0.25) * squared * per_texture2)
        robust *= robust
        texture_squares += robust * squared
        texture_weights += robust
        w = -np.sqrt(robust * trust * q[12] * per_texture2)
        # A camera motion moves the map point by minus itself in camera axes: J = -(g, s x g).
        hx, hy, hz = w * m[10], w * m[11], w * m[12]
        hx, hy, hz = r00 * hx + r01 * hy + r02 * hz, r10 * hx + r11 * hy + r12 * hz, r20 * hx + r21 * hy + r22 * hz
        textured[0, texture_used], textured[1, texture_used], textured[2, texture_used] = hx, hy, hz
        textured[3, texture_used] = sy * hz - sz * hy
        textured[4, texture_used] = sz * hx - sx * hz
        textured[5, texture_used] = sx * hy - sy * hx
        hx, hy, hz = w * q[7], w * q[8], w * q[9]
        textured[6, texture_used], textured[7, texture_used], textured[8, texture_used] = hx, hy, hz
        textured[9, texture_used] = sy * hz - sz * hy
        textured[10, texture_used] = sz * hx - sx * hz
        textured[11, texture_used] = sx * hy - sy * hx
        textured[12, texture_used] = -w * difference
        texture_used += 1
    sums = (squares, weights, texture_squares, texture_weights, of_map, of_both, inverse_counts)
    return (visible, used, texture_used, settled), sums
