"""Phase -> depth through a lookup built from the calibration, with full Brown-Conrady on both lenses.

Along the ray of a camera pixel the projector coordinate x_p is a smooth, monotonic function of depth. With
x_c, its value at mid-depth, 1/z is a cubic in d = x_p - x_c: the pinhole's is a homography of one
variable, and distortion adds little. Six planes hold x_c, the four coefficients and the ray, full along
the row and every ``ROW_STEP_PX`` camera rows, linear between: 1..4 MB, under 0.1 um from the exact solution.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from endo3d_core.calibration import Rig
from endo3d_core.compiled import kernel
from endo3d_core.patterns import Axis

ROW_STEP_PX = 16
NODES = 6
"""Depths per pixel that the cubic is fitted to."""

CENTRE, C0, C1, C2, C3, RAY_X, RAY_Y = range(7)
"""Planes of ``Lookup.planes``."""
ROW_PLANES = 9
"""Of a row's scratch: the lookup's seven, depth and its sigma."""


@dataclass(frozen=True, eq=False)
class Lookup:
    """What a grid's row needs to turn projector coordinates into points. Made by ``build``."""

    planes: NDArray[np.float32]
    """(7, nodes, width): x_c in projector px, c0..c3 of 1/z in 1/mm per px^n, ray x and y."""
    rows_per_node: float
    """Grid rows between two nodes."""
    height: int
    width: int
    z_min_mm: float
    z_max_mm: float
    period_px: float
    """Projector pixels of the coded axis: a frequency counts periods over these."""
    centre_slope: float
    """Median of d x_c / d column, in projector px per grid px: the carrier."""
    reach_px: float
    """The most that x_p leaves x_c within the depth range, in projector px."""
    axis: Axis


def grid_pixels(rig: Rig, bin_px: int, axis: Axis) -> NDArray[np.float64]:
    """(height, width, 2) camera pixels of the grid's bin centres; transposed for patterns along rows."""
    pixels = rig.camera.binned(bin_px).pixel_grid() * bin_px + 0.5 * (bin_px - 1)
    return pixels if axis == "columns" else np.ascontiguousarray(pixels.transpose(1, 0, 2))


def coded(pixels: NDArray[np.float64], axis: Axis) -> NDArray[np.float64]:
    """The coordinate that the patterns code, of (..., 2) projector pixels."""
    return pixels[..., 0 if axis == "columns" else 1]


def build(rig: Rig, bin_px: int, z_min_mm: float, z_max_mm: float, axis: Axis = "columns") -> Lookup:
    """The lookup of a binned camera grid between two depths; ``axis`` is what the patterns code.

    For rows the grid is transposed, so that the phase always runs along the second axis.
    """
    if not 0 < z_min_mm < z_max_mm:
        raise ValueError(f"the depth range {z_min_mm:g}..{z_max_mm:g} mm is empty")
    grid = grid_pixels(rig, bin_px, axis)
    height, width = grid.shape[:2]
    rows_per_node = ROW_STEP_PX / bin_px
    node_rows = np.arange(int(np.ceil((height - 1) / rows_per_node)) + 1) * rows_per_node
    step = grid[1, 0] - grid[0, 0]
    pixels = grid[0][None] + node_rows[:, None, None] * step
    rays = rig.camera.ray(pixels)
    inverse_range = np.array((1.0 / z_max_mm, 1.0 / z_min_mm))
    centre = coded(rig.projector_pixel(rays / inverse_range.mean()), axis)
    # Chebyshev nodes in 1/z: the least-squares cubic through them is near the minimax one.
    chebyshev = np.cos(np.pi * (np.arange(NODES) + 0.5) / NODES)
    inverse_z = inverse_range.mean() + 0.5 * np.ptp(inverse_range) * chebyshev
    offset = np.stack([coded(rig.projector_pixel(rays / q), axis) for q in inverse_z], axis=-1) - centre[..., None]
    scale = np.abs(offset).max()
    if not np.isfinite(scale):
        raise ValueError("the projector's lens model folds over inside the working volume")
    powers = (offset / scale)[..., None] ** np.arange(4)
    cubic = np.linalg.pinv(powers) @ inverse_z / scale ** np.arange(4)
    planes = np.stack((centre, *np.moveaxis(cubic, -1, 0), rays[..., 0], rays[..., 1]))
    period = rig.projector.width if axis == "columns" else rig.projector.height
    return Lookup(
        planes=np.ascontiguousarray(planes, np.float32),
        rows_per_node=rows_per_node,
        height=height,
        width=width,
        z_min_mm=z_min_mm,
        z_max_mm=z_max_mm,
        period_px=float(period),
        reach_px=float(scale),
        centre_slope=float(np.median(np.diff(centre, axis=1))),
        axis=axis,
    )


@kernel
def interpolate_row(planes: NDArray[np.float32], position: float, row: NDArray[np.float32]) -> None:
    """Planes (7, nodes, width) at a node position -> the first 7 of row (9, width)."""
    node = min(int(position), planes.shape[1] - 2)
    t = np.float32(position - node)
    for p in range(planes.shape[0]):
        a, b, out = planes[p, node], planes[p, node + 1], row[p]
        for x in range(out.size):
            out[x] = a[x] + t * (b[x] - a[x])


@kernel
def interpolate_strip(
    planes: NDArray[np.float32], position: float, left: int, right: int, row: NDArray[np.float32]
) -> None:
    """The same for columns left..right -> the first 7 of row (9, right - left or more)."""
    node = min(int(position), planes.shape[1] - 2)
    t = np.float32(position - node)
    for p in range(planes.shape[0]):
        a, b, out = planes[p, node, left:right], planes[p, node + 1, left:right], row[p]
        for x in range(a.size):
            out[x] = a[x] + t * (b[x] - a[x])


@kernel
def carrier(planes: NDArray[np.float32], per_node: float, scale: float, out: NDArray[np.float32]) -> None:
    """The mid-depth coordinate times ``scale`` -> out (height, width): phase in rad for scale = 2 pi f /
    period."""
    factor = np.float32(scale)
    for v in range(out.shape[0]):
        position = v / per_node
        node = min(int(position), planes.shape[1] - 2)
        t = np.float32(position - node)
        a, b, row = planes[0, node], planes[0, node + 1], out[v]
        for x in range(row.size):
            row[x] = factor * (a[x] + t * (b[x] - a[x]))


@kernel
def write_row(
    row: NDArray[np.float32],
    px_per_rad: np.float32,
    z_min: np.float32,
    z_max: np.float32,
    residual: NDArray[np.float32],
    intensity: NDArray[np.float32],
    quality: NDArray[np.float32],
    variance: NDArray[np.float32],
    points: NDArray[np.float32],
) -> int:
    """One row of phases relative to mid-depth, rad -> points (width, 6); returns the valid count.

    NaN phases and depths outside z_min..z_max become NaN points. ``row`` is the row's lookup from
    ``interpolate_row``; its last two rows are scratch.
    """
    c0, c1, c2, c3, rx, ry = row[1], row[2], row[3], row[4], row[5], row[6]
    z_row, s_row = row[7], row[8]
    two, three, one = np.float32(2.0), np.float32(3.0), np.float32(1.0)
    zero, nan = np.float32(0.0), np.float32(np.nan)
    count = np.int32(0)
    for x in range(residual.size):
        d = residual[x] * px_per_rad
        z = one / (c0[x] + d * (c1[x] + d * (c2[x] + d * c3[x])))
        slope = z * z * (c1[x] + d * (two * c2[x] + d * three * c3[x])) * px_per_rad
        inside = (z >= z_min) & (z <= z_max)
        z_row[x] = z if inside else nan
        s_row[x] = slope * slope * variance[x]
    for x in range(residual.size):
        # A NaN depth makes its sigma NaN; a choice would put the root into a branch and end vectorisation.
        s_row[x] = np.sqrt(s_row[x]) + (z_row[x] - z_row[x])
    for x in range(residual.size):
        z, q = z_row[x], quality[x]
        points[x, 0] = rx[x] * z
        points[x, 1] = ry[x] * z
        points[x, 2] = z
        points[x, 3] = intensity[x]
        points[x, 4] = q if z == z else zero
        points[x, 5] = s_row[x]
    for x in range(residual.size):
        count += np.int32(z_row[x] == z_row[x])
    return int(count)


@kernel
def write_points(
    planes: NDArray[np.float32],
    per_node: float,
    px_per_rad: float,
    z_min: float,
    z_max: float,
    residual: NDArray[np.float32],
    intensity: NDArray[np.float32],
    quality: NDArray[np.float32],
    variance: NDArray[np.float32],
    row: NDArray[np.float32],
    points: NDArray[np.float32],
) -> int:
    """``write_row`` over a grid (height, width); ``row`` is scratch, ``ROW_PLANES`` by width."""
    scale, low, high = np.float32(px_per_rad), np.float32(z_min), np.float32(z_max)
    count = 0
    for v in range(residual.shape[0]):
        interpolate_row(planes, v / per_node, row)
        count += write_row(row, scale, low, high, residual[v], intensity[v], quality[v], variance[v], points[v])
    return count


@kernel
def write_depth(points: NDArray[np.float32], scale_mm: float, offset_mm: float, depth: NDArray[np.uint16]) -> None:
    """points (height, width, 6) -> depth (height, width): z = offset + scale * value, 0 where invalid."""
    per_mm, offset, half = np.float32(1.0 / scale_mm), np.float32(offset_mm), np.float32(0.5)
    for v in range(depth.shape[0]):
        p, row = points[v], depth[v]
        for x in range(row.size):
            value = (p[x, 2] - offset) * per_mm + half
            row[x] = np.uint16(value) if (value >= np.float32(1.0)) & (value < np.float32(65535.0)) else np.uint16(0)


def exact_depth(
    rig: Rig,
    pixels: NDArray[np.float64],
    coordinate: NDArray[np.float64],
    guess_mm: float,
    axis: Axis = "columns",
) -> NDArray[np.float64]:
    """Depth along camera pixels (..., 2) that projects onto the coded coordinate (...): Newton in float64.

    The reference that the lookup is measured against; not for frames.
    """
    rays = rig.camera.ray(pixels)
    q = np.full(coordinate.shape, 1.0 / guess_mm)
    step = 1e-6
    for _ in range(30):
        value = coded(rig.projector_pixel(rays / q[..., None]), axis)
        ahead = coded(rig.projector_pixel(rays / (q + step)[..., None]), axis)
        q = q - (value - coordinate) * step / (ahead - value)
    return 1.0 / q
