"""Projective registration of a cloud to the visible part of the merged map (sections 3.3 and 5 of the paper).

Map points are projected into the organised grid, which replaces the closest-point search of ICP. Rows are
point-to-plane, weighted by variance, observation count and robustly; in directions where the geometry is weak,
rows of the texture (``photometric``) join in.

The unknown is a small motion of the camera in its own axes, about the centre of the visible surface, with the
rotation scaled by the surface's radius: all six numbers are mm and comparable.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from endo3d_core import rigid
from endo3d_core.compiled import kernel
from endo3d_core.merging import COUNT, TEXTURE, MergedMap
from endo3d_core.normals import TEXTURE_SLOPE_VARIANCE

Array = NDArray[np.float64]

_VISIBLE, _USED, _SQUARES, _WEIGHTS = 0, 1, 2, 3
_TEXTURED, _TEXTURE_SQUARES, _TEXTURE_WEIGHTS = 4, 5, 6
_NOISE_WEIGHT = 7
_STATISTICS = 8

SAME_SURFACE = 0.8
"""Least cosine between the normals of a pair (37 deg)."""
GRAZING = 0.3
"""Least cosine between normal and view: beyond, a ray's noise is mostly along the surface."""
FACING = 0.9
"""Least view cosine of a photometric row: on flanks, shading changes with the pose."""


@dataclass(slots=True)
class NormalEquations:
    """Normal equations of one linearisation: information, gradient and what the rows were like."""

    geometry: Array
    geometry_gradient: Array
    texture: Array
    texture_gradient: Array
    geometry_noise: Array
    """The part of ``geometry`` that noisy normals alone would make."""
    texture_noise: Array
    """The part of ``texture`` that grey noise alone would make."""
    visible: int
    used: int
    textured: int
    residual_mm: float
    """Robust rms of the rows' distances."""
    texture_residual: float
    centre: Array
    """(3,) mm: the point in camera axes that rotations are about."""
    radius_mm: float


def visible_surface(live: NDArray[np.float32], stride: int = 4) -> tuple[Array, float]:
    """Centre (3,) and rms radius (mm) of the points of live (rows, columns, >= 3): the scale of rotations."""
    points = live[::stride, ::stride, :3].reshape(-1, 3)
    points = points[np.isfinite(points[:, 2])].astype(np.float64)
    centre = points.mean(axis=0)
    return centre, float(np.sqrt(((points - centre) ** 2).sum(axis=1).mean()))


class Linearisation:
    """Builds normal equations at a pose; owns the scratch arrays."""

    def __init__(self) -> None:
        self._sums = np.zeros((4, 6, 6))
        self._gradients = np.zeros((2, 6))
        self._moments = np.zeros(10)
        self._statistics = np.zeros(_STATISTICS)

    def at(
        self,
        T_world_camera: Array,
        world: MergedMap,
        rows: NDArray[np.int32],
        live: NDArray[np.float32],
        coefficients: NDArray[np.float32],
        *,
        centre: Array,
        radius_mm: float,
        gate_mm: float,
        scale_mm: float,
        texture_scale: float,
        texture_sigma: float,
        normal_sigma: float,
        photometric: bool,
        stride: int = 1,
    ) -> NormalEquations:
        """Of the map's ``rows`` against ``live``.

        Distances beyond ``gate_mm`` are no pairs; ``scale_mm`` and ``texture_scale`` are the robust scales of the
        two kinds of residuals; ``normal_sigma`` and ``texture_sigma`` are the noise of one cloud's normals and texture.
        """
        for sums in (self._sums, self._gradients, self._moments, self._statistics):
            sums[:] = 0.0
        _accumulate(
            world.rows, world.ints, rows, live, coefficients, np.ascontiguousarray(rigid.inverse(T_world_camera)),
            centre, radius_mm, gate_mm, scale_mm, texture_scale, normal_sigma, photometric, stride,
            self._sums, self._gradients, self._moments, self._statistics,
        )  # fmt: skip
        for block in self._sums:
            block += np.triu(block.T, 1)
        s = self._statistics
        geometry, texture, texture_noise = self._sums[0].copy(), self._sums[1].copy(), TEXTURE_SLOPE_VARIANCE * texture_sigma**2 * self._sums[2]
        mean_noise = self._moments[0] / max(np.trace(geometry[:3, :3]), 1e-300)
        return NormalEquations(
            geometry=geometry,
            geometry_gradient=self._gradients[0].copy(),
            texture=texture,
            texture_gradient=self._gradients[1].copy(),
            geometry_noise=_isotropic(self._moments) - mean_noise * geometry,
            texture_noise=texture_noise,
            visible=int(s[_VISIBLE]),
            used=int(s[_USED]),
            textured=int(s[_TEXTURED]),
            residual_mm=float(np.sqrt(s[_SQUARES] / max(s[_WEIGHTS], 1e-300))),
            texture_residual=float(np.sqrt(s[_TEXTURE_SQUARES] / max(s[_TEXTURE_WEIGHTS], 1e-300))),
            centre=centre,
            radius_mm=radius_mm,
        )


def _isotropic(moments: Array) -> Array:
    """(6, 6) information of normals that point anywhere, from the sums of w, w s and w s s^T."""
    w, s, ss = moments[0], moments[1:4], moments[4:10]
    S = np.array([[ss[0], ss[3], ss[4]], [ss[3], ss[1], ss[5]], [ss[4], ss[5], ss[2]]])
    M = np.zeros((6, 6))
    M[:3, :3] = w * np.eye(3)
    M[3:, :3] = rigid.skew(s)
    M[:3, 3:] = M[3:, :3].T
    M[3:, 3:] = np.trace(S) * np.eye(3) - S
    return M


@kernel
def _accumulate(  # type: ignore[no-untyped-def]
    map_rows, map_ints, visible, live, coefficients, T_camera_world, centre, radius, gate, scale, texture_scale,
    normal_sigma, photometric, stride, sums, gradients, moments, statistics,
):  # fmt: skip
    f = np.float32
    T = T_camera_world
    r00, r01, r02, tx = f(T[0, 0]), f(T[0, 1]), f(T[0, 2]), f(T[0, 3])
    r10, r11, r12, ty = f(T[1, 0]), f(T[1, 1]), f(T[1, 2]), f(T[1, 3])
    r20, r21, r22, tz = f(T[2, 0]), f(T[2, 1]), f(T[2, 2]), f(T[2, 3])
    c0, c1, c2, c3, c4 = coefficients[0]
    d0, d1, d2, d3, d4 = coefficients[1]
    gx, gy, gz, per_radius = f(centre[0]), f(centre[1]), f(centre[2]), f(1.0 / radius)
    one, three, half = f(1.0), f(3.0), f(0.5)
    inverse_scale2, gate32 = f(1.0 / (4.0 * scale * scale)), f(gate)
    texture_weight, inverse_texture2 = f(1.0 / texture_scale**2), f(1.0 / (4.0 * texture_scale**2))
    J = np.zeros(6, np.float32)
    A = np.zeros(6, np.float32)
    B = np.zeros(6, np.float32)
    rows, columns = live.shape[0], live.shape[1]
    for i in range(0, visible.size, stride):
        m = map_rows[visible[i]]
        x = r00 * m[0] + r01 * m[1] + r02 * m[2] + tx
        y = r10 * m[0] + r11 * m[1] + r12 * m[2] + ty
        z = r20 * m[0] + r21 * m[1] + r22 * m[2] + tz
        if not z > f(0.0):
            continue
        a, b = x / z, y / z
        r2 = a * a + b * b
        u = c0 + c1 * a + c2 * b + r2 * (c3 * a + c4 * b)
        v = d0 + d1 * a + d2 * b + r2 * (d3 * a + d4 * b)
        column, row = int(u + half), int(v + half)
        if not (u > -half and v > -half and column < columns and row < rows):
            continue
        q = live[row, column]
        if not q[3] == q[3]:
            continue
        statistics[_VISIBLE] += 1.0
        nx = r00 * m[3] + r01 * m[4] + r02 * m[5]
        ny = r10 * m[3] + r11 * m[4] + r12 * m[5]
        nz = r20 * m[3] + r21 * m[4] + r22 * m[5]
        if nx * q[3] + ny * q[4] + nz * q[5] < f(SAME_SURFACE):
            continue
        facing = -(nx * a + ny * b + nz) / np.sqrt(one + r2)
        if facing < f(GRAZING):
            continue
        # Where the map point's own ray meets the live tangent plane: a pair without a tangential offset, which
        # the noise of the map's normals would turn into a pull towards whole cells.
        ahead = (q[3] * q[0] + q[4] * q[1] + q[5] * q[2]) / (q[3] * x + q[4] * y + q[5] * z)
        residual = (nx * x + ny * y + nz * z) * (ahead - one)
        if abs(residual) > gate32:
            continue
        statistics[_USED] += 1.0
        # Variance along the normal: the live point's, and the map point's that averages `count` of them.
        count = f(map_ints[visible[i], COUNT])
        weight = q[9] / (facing * facing) * count / (count + one)
        robust = one / (one + residual * residual * inverse_scale2)
        robust *= robust
        statistics[_SQUARES] += robust * residual * residual
        statistics[_WEIGHTS] += robust
        w = weight * robust
        sx, sy, sz = (q[0] - gx) * per_radius, (q[1] - gy) * per_radius, (q[2] - gz) * per_radius
        J[0], J[1], J[2] = nx, ny, nz
        J[3], J[4], J[5] = sy * nz - sz * ny, sz * nx - sx * nz, sx * ny - sy * nx
        for k in range(6):
            wj = w * J[k]
            gradients[0, k] -= wj * residual
            for n in range(k + 1):
                sums[0, k, n] += wj * J[n]
        tilt = w * f(normal_sigma * normal_sigma) / count
        moments[0] += tilt
        moments[1] += tilt * sx
        moments[2] += tilt * sy
        moments[3] += tilt * sz
        moments[4] += tilt * sx * sx
        moments[5] += tilt * sy * sy
        moments[6] += tilt * sz * sz
        moments[7] += tilt * sx * sy
        moments[8] += tilt * sx * sz
        moments[9] += tilt * sy * sz
        if not (photometric and facing >= f(FACING) and q[7] + q[8] == q[7] + q[8]):
            continue
        # The live texture where the map point falls: bilinear, from the offset to this cell's own ray. (The
        # slopes are too smooth for it: they would pull towards whole cells.)
        fx, fy = c1 + c3 * (three * a * a + b * b), d2 + d4 * (a * a + three * b * b)
        du, dv = fx * (a - q[0] / q[2]), fy * (b - q[1] / q[2])
        aside, below = column + (1 if du > f(0.0) else -1), row + (1 if dv > f(0.0) else -1)
        du, dv = abs(du), abs(dv)
        here = (one - du) * q[6] + du * live[row, aside, 6]
        there = (one - du) * live[below, column, 6] + du * live[below, aside, 6]
        difference = (one - dv) * here + dv * there - m[TEXTURE]
        if not abs(difference) < f(1.0):
            continue
        # A camera motion moves the map point by minus itself in camera axes.
        per_z = one / z
        hx, hy = x - gx, y - gy
        hz = z - gz
        hx, hy, hz = hx * per_radius, hy * per_radius, hz * per_radius
        ux, uz = -fx * per_z, fx * a * per_z
        vy, vz = -fy * per_z, fy * b * per_z
        A[0], A[1], A[2], A[3], A[4], A[5] = ux, f(0.0), uz, hy * uz, hz * ux - hx * uz, -hy * ux
        B[0], B[1], B[2], B[3], B[4], B[5] = f(0.0), vy, vz, hy * vz - hz * vy, -hx * vz, hx * vy
        robust = one / (one + difference * difference * inverse_texture2)
        robust *= robust
        statistics[_TEXTURED] += 1.0
        statistics[_TEXTURE_SQUARES] += robust * difference * difference
        statistics[_TEXTURE_WEIGHTS] += robust
        w = texture_weight * robust * count / (count + one)
        for k in range(6):
            jk = q[7] * A[k] + q[8] * B[k]
            gradients[1, k] -= w * jk * difference
            for n in range(k + 1):
                sums[1, k, n] += w * jk * (q[7] * A[n] + q[8] * B[n])
                sums[2, k, n] += w * (A[k] * A[n] + B[k] * B[n])
