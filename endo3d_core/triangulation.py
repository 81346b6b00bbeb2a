"""Phase -> depth through a lookup built from the calibration, with full Brown-Conrady on both lenses.

Along the ray of a camera pixel the projector coordinate x_p is a smooth, monotonic function of depth. With
x_c, its value at mid-depth, 1/z is a cubic in d = x_p - x_c: the pinhole's is a homography of one
variable, and distortion adds little. Six planes hold x_c, the four coefficients and the ray, full along
the row and every ``ROW_STEP_PX`` camera rows, linear between: 1..4 MB, under 0.1 um from the exact solution.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from endo3d_core.calibration import Rig
from endo3d_core.compiled import kernel
from endo3d_core.packing import pack_points, pack_xyz
from endo3d_core.patterns import Axis
from endo3d_core.phase import reciprocal, root

ROW_STEP_PX = 16
NODES = 6
"""Depths per pixel that the cubic is fitted to."""

CENTRE, C0, C1, C2, C3, RAY_X, RAY_Y = range(7)
"""Planes of ``Lookup.planes``."""
X, Y, Z, INTENSITY, QUALITY, SIGMA = range(6)
"""A point's channels, and the rows of what is packed into a row of points."""


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
    x = offset / scale
    powers = np.stack((np.ones_like(x), x, x * x, x * x * x), axis=-1)
    corrected = inverse_z + rig.bow(rays[..., :1], rays[..., 1:2], inverse_z)
    # By the normal equations, which are tame on these nodes: a singular value decomposition takes ten times as long.
    gram, moments = np.swapaxes(powers, -1, -2) @ powers, np.swapaxes(powers, -1, -2) @ corrected[..., None]
    cubic = np.linalg.solve(gram, moments)[..., 0] / scale ** np.arange(4)
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
def interpolate_row(planes: NDArray[np.float32], position: float, left: int, row: NDArray[np.float32]) -> None:
    """Planes (n, nodes, width) at a node position, from column ``left`` on -> row (n, columns)."""
    node = min(int(position), planes.shape[1] - 2)
    t = np.float32(position - node)
    for p in range(planes.shape[0]):
        a, b, out = planes[p, node, left : left + row.shape[1]], planes[p, node + 1, left : left + row.shape[1]], row[p]
        for x in range(out.size):
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
def triangulate_row(
    cubic: NDArray[np.float32],
    px_per_rad: np.float32,
    z_min: np.float32,
    z_max: np.float32,
    phase: NDArray[np.float32],
    variance: NDArray[np.float32],
    z: NDArray[np.float32],
    sigma: NDArray[np.float32],
) -> None:
    """Phases relative to mid-depth, rad, and their variances -> depths and their sigmas, mm, all (width,).

    ``cubic`` (4, width) holds C0..C3 of the row. NaN phases and depths outside z_min..z_max become NaN.
    """
    c0, c1, c2, c3 = cubic[0], cubic[1], cubic[2], cubic[3]
    two, three, nan = np.float32(2.0), np.float32(3.0), np.float32(np.nan)
    for x in range(phase.size):
        d = phase[x] * px_per_rad
        depth = reciprocal(c0[x] + d * (c1[x] + d * (c2[x] + d * c3[x])))
        slope = depth * depth * (c1[x] + d * (two * c2[x] + d * three * c3[x])) * px_per_rad
        inside = (depth >= z_min) & (depth <= z_max)
        kept = depth if inside else nan
        z[x] = kept
        # A NaN depth makes its sigma NaN.
        sigma[x] = abs(slope) * root(variance[x]) + (kept - kept)


class Output(NamedTuple):
    """Where a decoder writes its result; an array of size 0 is not wanted."""

    points: NDArray[np.float32]
    """(height, width, 6): x y z mm, intensity in grey values, quality 0..1, sigma of z mm."""
    xyz: NDArray[np.float32]
    """(height, width, 3) mm."""
    depth: NDArray[np.uint16]
    """(height, width): z = offset + scale * value, 0 where invalid."""
    scale_mm: float
    offset_mm: float


def output(
    points: NDArray[np.float32] | None = None,
    xyz: NDArray[np.float32] | None = None,
    depth: NDArray[np.uint16] | None = None,
    scale_mm: float = 1.0,
    offset_mm: float = 0.0,
) -> Output:
    """An ``Output`` of what is given, each C-contiguous."""
    return Output(
        _NO_POINTS if points is None else points,
        _NO_POINTS if xyz is None else xyz,
        _NO_DEPTH if depth is None else depth,
        scale_mm,
        offset_mm,
    )


_NO_POINTS, _NO_DEPTH = np.zeros((0, 0, 0), np.float32), np.zeros((0, 0), np.uint16)


def on_camera_grid(axis: Axis, out: Output, decode: Callable[[Output], int]) -> int:
    """Run ``decode`` on the decoder's grid; for patterns along rows that is the camera's transposed."""
    if axis == "columns":
        return decode(out)
    turned = out._replace(
        points=np.empty(_turned(out.points.shape), np.float32),
        xyz=np.empty(_turned(out.xyz.shape), np.float32),
        depth=np.empty(_turned(out.depth.shape), np.uint16),
    )
    count = decode(turned)
    out.points[:], out.xyz[:] = turned.points.swapaxes(0, 1), turned.xyz.swapaxes(0, 1)
    out.depth[:] = turned.depth.T
    return count


def _turned(shape: tuple[int, ...]) -> tuple[int, ...]:
    return (shape[1], shape[0], *shape[2:])


@kernel
def write_row(values: NDArray[np.float32], rays: NDArray[np.float32], v: int, left: int, out: Output) -> int:
    """Values (6, columns) of row v, without x and y, and its rays (2, columns) -> all that ``out`` wants.

    ``left`` is their first column; returns the number of valid points.
    """
    x_row, y_row, z, quality, ray_x, ray_y = values[X], values[Y], values[Z], values[QUALITY], rays[0], rays[1]
    zero, one, count, right = np.float32(0.0), np.float32(1.0), np.float32(0.0), left + values.shape[1]
    if out.points.size + out.xyz.size > 0:
        for x in range(z.size):
            x_row[x] = ray_x[x] * z[x]
            y_row[x] = ray_y[x] * z[x]
    if out.points.size > 0:
        for x in range(z.size):
            q, depth = quality[x], z[x]
            quality[x] = q if depth == depth else zero
        pack_points(values, out.points[v, left:right])
    if out.xyz.size > 0:
        pack_xyz(values[:3], out.xyz[v, left:right])
    if out.depth.size > 0:
        _write_depths(z, np.float32(1.0 / out.scale_mm), np.float32(out.offset_mm), out.depth[v, left:right])
    for x in range(z.size):
        depth = z[x]
        count += one if depth == depth else zero
    return int(count)


@kernel
def _write_depths(z: NDArray[np.float32], per_mm: np.float32, offset: np.float32, depths: NDArray[np.uint16]) -> None:
    half, least, most, zero = np.float32(0.5), np.float32(1.0), np.float32(65535.0), np.float32(0.0)
    for x in range(z.size):
        value = (z[x] - offset) * per_mm + half
        kept = value if (value >= least) & (value < most) else zero
        depths[x] = np.uint16(np.int32(kept))


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
    return 1.0 / (q + rig.bow(rays[..., 0], rays[..., 1], q))
