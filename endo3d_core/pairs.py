"""Pairs of map points and cells of the live cloud, by projection, and their rows of the linear system.

Works through the map points in blocks that stay in the fastest cache: the scattered reads of a block come first and
fill a table with a row per quantity, then the arithmetic runs along the rows, which vectorises. The offsets of rows
are constants for that reason.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d_core import pooling
from endo3d_core.compiled import kernel
from endo3d_core.merging import COUNT, SETTLED

SAME_SURFACE = 0.8
"""Least cosine between the normals of a pair (37 deg)."""
GRAZING = 0.3
"""Least cosine between normal and view: beyond, a ray's noise is mostly along the surface."""
FACING = 0.9
"""Least view cosine of a photometric row: on flanks, shading changes with the pose."""
AVERAGED = 25.0
"""Averaging makes normals at most so many times less noisy (in variance): ripple of the decoder is no white noise."""
TILT_STRIDE = 8

BLOCK = 256

# The table of a block. Of the map point: position in the camera's axes, normal and texture gradient in the world's.
MX, MY, MZ, MNX, MNY, MNZ, MTEXTURE, MGX, MGY, MGZ, MCOUNT = (BLOCK * k for k in range(11))
# Of the live cell; its texture is interpolated to where the map point falls.
LX, LY, LZ, LNX, LNY, LNZ, LTEXTURE, LGX, LGY, LGZ, LWEIGHT, LTEXTURE_WEIGHT = (BLOCK * k for k in range(11, 23))
PAIRS = 23 * BLOCK

# Point-to-plane rows: J (6), distance; then 1 and the scaled position (3) weighted with the noise of the normal; one
# minus the cosine between the normals; the view cosine, zero where there is no pair.
JACOBIAN, DISTANCE, TILT, APART, VIEW = 0, 6 * BLOCK, 7 * BLOCK, 11 * BLOCK, 12 * BLOCK
SURFACE = 13 * BLOCK
# Photometric rows: J with the map's gradient (6), with the cloud's (6), difference.
OF_MAP, OF_LIVE, DIFFERENCE = 0, 6 * BLOCK, 12 * BLOCK
TEXTURE = 13 * BLOCK


@kernel
def associate(
    map_rows: Any, map_ints: Any, chosen: NDArray[np.int32], live: Any, coefficients: Any, T: Any,
    pairs: NDArray[np.float32],
) -> Any:  # fmt: skip
    """Projects the map points ``chosen`` (at most BLOCK) into the grid of the camera T_camera_world; the pairs' number.

    A pair has a cell with a normal.
    """
    r00, r01, r02, tx = np.float32(T[0, 0]), np.float32(T[0, 1]), np.float32(T[0, 2]), np.float32(T[0, 3])
    r10, r11, r12, ty = np.float32(T[1, 0]), np.float32(T[1, 1]), np.float32(T[1, 2]), np.float32(T[1, 3])
    r20, r21, r22, tz = np.float32(T[2, 0]), np.float32(T[2, 1]), np.float32(T[2, 2]), np.float32(T[2, 3])
    c, d = coefficients[0], coefficients[1]
    c0, c1, c2, c3, c4 = c[0], c[1], c[2], c[3], c[4]
    d0, d1, d2, d3, d4 = d[0], d[1], d[2], d[3], d[4]
    zero, half, one, three = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(3.0)
    rows, columns = live.shape[1], live.shape[2]
    planes = live.reshape(live.shape[0], rows * columns)
    texture = planes[pooling.TEXTURE]
    n = 0
    for i in range(chosen.size):
        m = map_rows[chosen[i]]
        x = r00 * m[0] + r01 * m[1] + r02 * m[2] + tx
        y = r10 * m[0] + r11 * m[1] + r12 * m[2] + ty
        z = r20 * m[0] + r21 * m[1] + r22 * m[2] + tz
        per_z = one / z
        a, b = x * per_z, y * per_z
        r2 = a * a + b * b
        u = c0 + c1 * a + c2 * b + r2 * (c3 * a + c4 * b) + half
        v = d0 + d1 * a + d2 * b + r2 * (d3 * a + d4 * b) + half
        if not ((z > zero) & (u > zero) & (v > zero) & (u < np.float32(columns)) & (v < np.float32(rows))):
            continue
        column, row = int(u), int(v)
        cell = row * columns + column
        if np.isnan(planes[pooling.NX, cell]):
            continue
        pairs[MX + n], pairs[MY + n], pairs[MZ + n] = x, y, z
        pairs[MNX + n], pairs[MNY + n], pairs[MNZ + n] = m[3], m[4], m[5]
        pairs[MTEXTURE + n], pairs[MGX + n], pairs[MGY + n], pairs[MGZ + n] = m[9], m[10], m[11], m[12]
        pairs[MCOUNT + n] = np.float32(map_ints[chosen[i], COUNT])
        px, py, pz = planes[pooling.X, cell], planes[pooling.Y, cell], planes[pooling.Z, cell]
        pairs[LX + n], pairs[LY + n], pairs[LZ + n] = px, py, pz
        pairs[LNX + n], pairs[LNY + n] = planes[pooling.NX, cell], planes[pooling.NY, cell]
        pairs[LNZ + n], pairs[LWEIGHT + n] = planes[pooling.NZ, cell], planes[pooling.WEIGHT, cell]
        pairs[LGX + n], pairs[LGY + n] = planes[pooling.GX, cell], planes[pooling.GY, cell]
        pairs[LGZ + n], pairs[LTEXTURE_WEIGHT + n] = planes[pooling.GZ, cell], planes[pooling.TEXTURE_WEIGHT, cell]
        # The texture is interpolated bilinearly, from the offset to this cell's own ray.
        per_pz = one / pz
        du = (c1 + c3 * (three * a * a + b * b)) * (a - px * per_pz)
        dv = (d2 + d4 * (a * a + three * b * b)) * (b - py * per_pz)
        aside, below = (1 if du > zero else -1), (columns if dv > zero else -columns)
        du, dv = abs(du), abs(dv)
        here = (one - du) * texture[cell] + du * texture[cell + aside]
        there = (one - du) * texture[cell + below] + du * texture[cell + below + aside]
        pairs[LTEXTURE + n] = (one - dv) * here + dv * there
        n += 1
    return n


@kernel
def surface_rows(
    pairs: NDArray[np.float32], n: int, T: Any, centre: Any, radius: float, gate: float, scale: float,
    normal_sigma: float, out: NDArray[np.float32],
) -> Any:  # fmt: skip
    """Weighted point-to-plane rows; returns how many pairs hold, robust sums of squares and of weights."""
    r00, r01, r02 = np.float32(T[0, 0]), np.float32(T[0, 1]), np.float32(T[0, 2])
    r10, r11, r12 = np.float32(T[1, 0]), np.float32(T[1, 1]), np.float32(T[1, 2])
    r20, r21, r22 = np.float32(T[2, 0]), np.float32(T[2, 1]), np.float32(T[2, 2])
    gx, gy, gz, per_radius = np.float32(centre[0]), np.float32(centre[1]), np.float32(centre[2]), np.float32(1 / radius)
    zero, one, averaged = np.float32(0.0), np.float32(1.0), np.float32(AVERAGED)
    same, grazing, gate32 = np.float32(SAME_SURFACE), np.float32(GRAZING), np.float32(gate)
    per_scale2, tilt_scale = np.float32(0.25 / (scale * scale)), np.float32(normal_sigma)
    used, squares, weights = zero, zero, zero
    for i in range(n):
        x, y, z, a, b, e = pairs[MX + i], pairs[MY + i], pairs[MZ + i], pairs[MNX + i], pairs[MNY + i], pairs[MNZ + i]
        qx, qy, qz, fx, fy, fz = (
            pairs[LX + i],
            pairs[LY + i],
            pairs[LZ + i],
            pairs[LNX + i],
            pairs[LNY + i],
            pairs[LNZ + i],
        )
        nx, ny, nz = r00 * a + r01 * b + r02 * e, r10 * a + r11 * b + r12 * e, r20 * a + r21 * b + r22 * e
        cosine = nx * fx + ny * fy + nz * fz
        along = nx * x + ny * y + nz * z
        view = -along / np.sqrt(x * x + y * y + z * z)
        # Where the map point's own ray meets the live tangent plane: a pair without a tangential offset, which
        # the noise of the map's normals would turn into a pull towards whole cells.
        ahead = (fx * qx + fy * qy + fz * qz) / (fx * x + fy * y + fz * z)
        distance = along * (ahead - one)
        holds = (cosine >= same) & (view >= grazing) & (abs(distance) <= gate32)
        pair = one if holds else zero
        distance = distance if holds else zero
        view = view if holds else one
        # The variance along the normal is the live point's, times 1 + 1/count for the map point's.
        count = pairs[MCOUNT + i]
        robust = one / (one + distance * distance * per_scale2)
        robust *= robust * pair
        used += pair
        squares += robust * distance * distance
        weights += robust
        w = np.sqrt(robust * count / (count + one) * pairs[LWEIGHT + i]) / view
        sx, sy, sz = (qx - gx) * per_radius, (qy - gy) * per_radius, (qz - gz) * per_radius
        out[i], out[BLOCK + i], out[2 * BLOCK + i] = w * nx, w * ny, w * nz
        out[3 * BLOCK + i] = w * (sy * nz - sz * ny)
        out[4 * BLOCK + i] = w * (sz * nx - sx * nz)
        out[5 * BLOCK + i] = w * (sx * ny - sy * nx)
        out[DISTANCE + i] = w * distance
        tilt = w * tilt_scale / np.sqrt(min(count, averaged))
        out[TILT + i], out[TILT + BLOCK + i] = tilt, tilt * sx
        out[TILT + 2 * BLOCK + i], out[TILT + 3 * BLOCK + i] = tilt * sy, tilt * sz
        out[APART + i] = max(one - cosine, zero)  # rounding may carry a cosine past one
        out[VIEW + i] = pair * view
    return int(used), squares, weights


@kernel
def texture_rows(
    pairs: NDArray[np.float32], n: int, surface: NDArray[np.float32], T: Any, centre: Any, radius: float,
    scale: float, out: NDArray[np.float32],
) -> Any:  # fmt: skip
    """Weighted photometric rows; returns counts of rows and of settled ones, and sums (see ``registration``)."""
    r00, r01, r02 = np.float32(T[0, 0]), np.float32(T[0, 1]), np.float32(T[0, 2])
    r10, r11, r12 = np.float32(T[1, 0]), np.float32(T[1, 1]), np.float32(T[1, 2])
    r20, r21, r22 = np.float32(T[2, 0]), np.float32(T[2, 1]), np.float32(T[2, 2])
    gx, gy, gz, per_radius = np.float32(centre[0]), np.float32(centre[1]), np.float32(centre[2]), np.float32(1 / radius)
    zero, one, quarter, facing = np.float32(0.0), np.float32(1.0), np.float32(0.25), np.float32(FACING)
    per_scale2, least_count = np.float32(1.0 / (scale * scale)), np.float32(SETTLED)
    used, settled, squares, weights, of_map, of_both, inverse_counts = zero, zero, zero, zero, zero, zero, zero
    misfit = zero
    for i in range(n):
        of_live, mapped, weight, count = (
            pairs[LTEXTURE + i],
            pairs[MTEXTURE + i],
            pairs[LTEXTURE_WEIGHT + i],
            pairs[MCOUNT + i],
        )
        a, b, e, f, g, h = (
            pairs[MGX + i],
            pairs[MGY + i],
            pairs[MGZ + i],
            pairs[LGX + i],
            pairs[LGY + i],
            pairs[LGZ + i],
        )
        qx, qy, qz = pairs[LX + i], pairs[LY + i], pairs[LZ + i]
        difference = of_live - mapped
        squared = difference * difference * weight
        holds = (surface[VIEW + i] >= facing) & (squared < one) & (f == f)
        row = one if holds else zero
        of_live, difference, squared = (
            of_live if holds else zero,
            difference if holds else zero,
            squared if holds else zero,
        )
        f, g, h = f if holds else zero, g if holds else zero, h if holds else zero
        known = row if count >= least_count else zero
        used += row
        settled += known
        inverse_counts += row / count
        misfit += squared
        of_map += known * mapped * mapped
        of_both += known * mapped * of_live
        robust = one / (one + quarter * squared * per_scale2)
        robust *= robust * row
        squares += robust * squared
        weights += robust
        w = -np.sqrt(robust * count / (count + one) * weight * per_scale2)
        sx, sy, sz = (qx - gx) * per_radius, (qy - gy) * per_radius, (qz - gz) * per_radius
        # A camera motion moves the map point by minus itself in camera axes: J = -(g, s x g).
        hx, hy, hz = (
            w * (r00 * a + r01 * b + r02 * e),
            w * (r10 * a + r11 * b + r12 * e),
            w * (r20 * a + r21 * b + r22 * e),
        )
        out[i], out[BLOCK + i], out[2 * BLOCK + i] = hx, hy, hz
        out[3 * BLOCK + i], out[4 * BLOCK + i] = sy * hz - sz * hy, sz * hx - sx * hz
        out[5 * BLOCK + i] = sx * hy - sy * hx
        hx, hy, hz = w * f, w * g, w * h
        out[OF_LIVE + i], out[OF_LIVE + BLOCK + i], out[OF_LIVE + 2 * BLOCK + i] = hx, hy, hz
        out[OF_LIVE + 3 * BLOCK + i], out[OF_LIVE + 4 * BLOCK + i] = sy * hz - sz * hy, sz * hx - sx * hz
        out[OF_LIVE + 5 * BLOCK + i] = sx * hy - sy * hx
        out[DIFFERENCE + i] = -w * difference
    return int(used), int(settled), squares, weights, of_map, of_both, inverse_counts, misfit


@kernel
def add_products(rows: NDArray[np.float32], first: int, count: int, n: int, gram: NDArray[np.float64]) -> None:
    """Adds the products of all pairs of ``count`` rows, from ``first`` on, to gram (count, count)."""
    for i in range(count):
        a = rows[first + i * BLOCK : first + i * BLOCK + n]
        for j in range(i + 1):
            b = rows[first + j * BLOCK : first + j * BLOCK + n]
            total: Any = np.float32(0.0)
            for k in range(n):
                total += a[k] * b[k]
            gram[i, j] += total


@kernel
def linearise(
    map_rows: Any, map_ints: Any, chosen: NDArray[np.int32], live: Any, coefficients: Any, T: Any, centre: Any,
    radius: float, gate: float, distance_scale: float, texture_scale: float, normal_sigma: float,
    pairs: Any, surface: Any, texture: Any, tilts: Any, surface_gram: Any, tilt_gram: Any, texture_gram: Any,
) -> Any:  # fmt: skip
    """Sums over all map points ``chosen``; the last three arrays are added to, in their lower triangles.

    Returns the numbers of visible, used, textured and settled points and of tilts, and the robust sums.
    """
    visible = used = textured = settled = sampled = 0
    squares = weights = texture_squares = texture_weights = of_map = of_both = inverse_counts = misfit = 0.0
    for first in range(0, chosen.size, BLOCK):
        n = associate(map_rows, map_ints, chosen[first : first + BLOCK], live, coefficients, T, pairs)
        visible += n
        count, sum_squares, sum_weights = surface_rows(
            pairs, n, T, centre, radius, gate, distance_scale, normal_sigma, surface
        )
        if count == 0:
            continue
        used, squares, weights = used + count, squares + sum_squares, weights + sum_weights
        for i in range(0, n, TILT_STRIDE):
            if surface[VIEW + i] > np.float32(0.0):
                tilts[sampled] = surface[APART + i]
                sampled += 1
        add_products(surface, JACOBIAN, 7, n, surface_gram)
        add_products(surface, TILT, 4, n, tilt_gram)
        count, known, sum_squares, sum_weights, sum_map, sum_both, sum_inverse, sum_misfit = texture_rows(
            pairs, n, surface, T, centre, radius, texture_scale, texture
        )
        if count == 0:
            continue
        textured, settled, inverse_counts = textured + count, settled + known, inverse_counts + sum_inverse
        texture_squares, texture_weights = texture_squares + sum_squares, texture_weights + sum_weights
        of_map, of_both, misfit = of_map + sum_map, of_both + sum_both, misfit + sum_misfit
        add_products(texture, OF_MAP, 13, n, texture_gram)
    sums = (squares, weights, texture_squares, texture_weights, of_map, of_both, inverse_counts, misfit)
    return (visible, used, textured, settled, sampled), sums
