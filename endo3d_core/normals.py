"""Surface normals and texture slopes by regression in the organised grid.

Pairs of cells opposite each other give the slope free of the centre's value and of curvature. Regressing in the
grid keeps the noise where it is, along the ray; the covariance of a neighbourhood of points would be biased
along it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d_core.compiled import kernel
from endo3d_core.pooling import GREY, GX, GY, GZ, NX, NY, NZ, TEXTURE, TEXTURE_WEIGHT, X, Y, Z

SLOPE_VARIANCE = 1.0 / 50.0
"""Variance of the 5x5 regression's slope, in cell variances per cell^2."""


@kernel
def _pair(ahead: Any, behind: Any, z: Any, reach: Any) -> Any:
    """(1, half the difference) of two opposite cells on the centre's surface, else (0, 0)."""
    near = (abs(ahead - z) <= reach) & (abs(behind - z) <= reach)
    one, zero = np.float32(1.0), np.float32(0.0)
    return (one if near else zero), (np.float32(0.5) * (ahead - behind) if near else zero)


@kernel
def slopes(depth: NDArray[np.float32], reach_mm: float, out: NDArray[np.float32]) -> None:
    """depth (rows, columns) mm -> out (2, rows, columns) mm per column and per row, from 5x5 cells.

    Only pairs within ``reach_mm`` of the centre count; NaN with fewer than 6 of the 12. Written out so that
    the loop over columns vectorises: 0.1 ms instead of 1.3 ms for 175 x 110 cells.
    """
    reach, zero, two, four = np.float32(reach_mm), np.float32(0.0), np.float32(2.0), np.float32(4.0)
    out[:] = np.float32(np.nan)
    for r in range(2, depth.shape[0] - 2):
        z0, z1, z2, z3, z4 = depth[r - 2], depth[r - 1], depth[r], depth[r + 1], depth[r + 2]
        slope_u, slope_v = out[0, r], out[1, r]
        for c in range(depth.shape[1] - 4):
            z = z2[c + 2]
            uu = uv = vv = uz = vz = count = zero
            k, g = _pair(z2[c + 3], z2[c + 1], z, reach)
            uu += k
            uz += g
            count += k
            k, g = _pair(z2[c + 4], z2[c], z, reach)
            uu += four * k
            uz += two * g
            count += k
            k, g = _pair(z3[c + 2], z1[c + 2], z, reach)
            vv += k
            vz += g
            count += k
            k, g = _pair(z4[c + 2], z0[c + 2], z, reach)
            vv += four * k
            vz += two * g
            count += k
            k, g = _pair(z3[c + 3], z1[c + 1], z, reach)
            uu += k
            uv += k
            vv += k
            uz += g
            vz += g
            count += k
            k, g = _pair(z3[c + 1], z1[c + 3], z, reach)
            uu += k
            uv -= k
            vv += k
            uz -= g
            vz += g
            count += k
            k, g = _pair(z3[c + 4], z1[c], z, reach)
            uu += four * k
            uv += two * k
            vv += k
            uz += two * g
            vz += g
            count += k
            k, g = _pair(z3[c], z1[c + 4], z, reach)
            uu += four * k
            uv -= two * k
            vv += k
            uz -= two * g
            vz += g
            count += k
            k, g = _pair(z4[c + 3], z0[c + 1], z, reach)
            uu += k
            uv += two * k
            vv += four * k
            uz += g
            vz += two * g
            count += k
            k, g = _pair(z4[c + 1], z0[c + 3], z, reach)
            uu += k
            uv -= two * k
            vv += four * k
            uz -= g
            vz += two * g
            count += k
            k, g = _pair(z4[c + 4], z0[c], z, reach)
            uu += four * k
            uv += four * k
            vv += four * k
            uz += two * g
            vz += two * g
            count += k
            k, g = _pair(z4[c], z0[c + 4], z, reach)
            uu += four * k
            uv -= four * k
            vv += four * k
            uz -= two * g
            vz += two * g
            count += k
            scale = np.float32(1.0) / (uu * vv - uv * uv) if count >= np.float32(6.0) else np.float32(np.nan)
            slope_u[c + 2] = (vv * uz - uv * vz) * scale
            slope_v[c + 2] = (uu * vz - uv * uz) * scale


@kernel
def orient(
    slope: NDArray[np.float32], coefficients: NDArray[np.float32], grey: float, planes: NDArray[np.float32]
) -> None:
    """Normals, texture gradients and texture weights of planes (PLANES, rows, columns) of ``pooling``.

    ``slope`` (2, rows, columns) as of ``slopes``, ``coefficients`` (2, 5) the pooled grid's rays, ``grey`` the cloud's
    typical intensity. The normal is NaN where the slope is, the gradient where a neighbour is missing.
    """
    one, three, sixth, zero = np.float32(1.0), np.float32(3.0), np.float32(1.0 / 6.0), np.float32(0.0)
    per_grey = np.float32(1.0 / max(grey, 1e-6))
    ax, ak, by, bk = coefficients[0, 1], coefficients[0, 3], coefficients[1, 2], coefficients[1, 4]
    rows, inner = planes.shape[1], planes.shape[2] - 2
    planes[NX : NZ + 1] = np.float32(np.nan)
    planes[GX : GZ + 1] = np.float32(np.nan)
    for r in range(1, rows - 1):
        before, here, after = planes[TEXTURE, r - 1], planes[TEXTURE, r], planes[TEXTURE, r + 1]
        px, py, pz, grey_row = planes[X, r], planes[Y, r], planes[Z, r], planes[GREY, r]
        normal_x, normal_y, normal_z = planes[NX, r], planes[NY, r], planes[NZ, r]
        gradient_x, gradient_y, gradient_z = planes[GX, r], planes[GY, r], planes[GZ, r]
        slope_u, slope_v, weight = slope[0, r], slope[1, r], planes[TEXTURE_WEIGHT, r]
        for i in range(inner):
            c = i + 1
            z, z_u, z_v = pz[c], slope_u[c], slope_v[c]
            per_z = one / z
            x, y = px[c] * per_z, py[c] * per_z
            # Cells per unit of x/z here: the fitted rays' Jacobian, its small cross terms left out.
            u_x, v_y = (ax + ak * (three * x * x + y * y)) * per_z, (by + bk * (x * x + three * y * y)) * per_z
            # Tangents: z_u (x, y, 1) + (1 / u_x, 0, 0) along the row, z_v (x, y, 1) + (0, 1 / v_y, 0) down the column.
            nx, ny = z_u * u_x, z_v * v_y
            nz = -(one + x * nx + y * ny)
            scale = one / np.sqrt(nx * nx + ny * ny + nz * nz)
            normal_x[c], normal_y[c], normal_z[c] = nx * scale, ny * scale, nz * scale
            t_u = (before[i + 2] + here[i + 2] + after[i + 2]) - (before[i] + here[i] + after[i])
            t_v = (after[i] + after[i + 1] + after[i + 2]) - (before[i] + before[i + 1] + before[i + 2])
            # A missing neighbour makes one of the two NaN, and the sum makes it all three, as does a missing normal.
            missing = zero * (t_u + t_v + scale)
            t_u, t_v = sixth * t_u * u_x + missing, sixth * t_v * v_y + missing
            gradient_x[c], gradient_y[c], gradient_z[c] = t_u, t_v, -(x * t_u + y * t_v)
            # Grey noise g makes texture noise g / surroundings.
            surroundings = grey_row[c] / (one + here[c]) * per_grey
            weight[c] = surroundings * surroundings
