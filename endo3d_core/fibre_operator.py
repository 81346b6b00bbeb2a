"""An imaging fibre's picture, evened out: camera pixels -> a regular grid at the fibre's resolution.

    grid = sharpen . interpolate . (divide by each core's gain) . (average each core's pixels) . pixels

All that depends on the bundle is computed once. The cores' light is interpolated in their Delaunay triangles, so a
grid point has three weights. On the regular grid the leaks into other cores are a convolution like the blurs of
averaging and interpolation, and so is their inverse: a Wiener filter of 7 x 7 points for the neighbours, and a mean
over coarse cells for the exponential tail. That matters where brightness changes: light that leaks from a highlight
carries its own fringe phase along.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import Delaunay

from endo3d_core import fibre_light
from endo3d_core.binning import Image
from endo3d_core.compiled import kernel
from endo3d_core.fibre import CoreMap
from endo3d_core.fibre_sharpening import CELL, CELL_REACH, REACH, mixing, sharpening, tail
from endo3d_core.uncertainty import ROUNDING, Sensor

SPOT_SHARE = 0.6
"""Width of the averaged spot over the core spacing: a core's bright middle."""
GAIN_LEAST = 0.2
"""Of the median gain: cores that are darker would amplify noise only."""
SMOOTH_SPACINGS = 12.0
"""A core's gain is its light over that of its surroundings, so wide."""
SLIVER = 6.0
"""Triangles that are so many times larger than usual don't count."""
LIT_SHARE = 0.1
"""The bundle is where the blurred flat is so bright, of its maximum."""
NOISE_WINDOW = (3, 5)
"""Rows and columns of the windowed fit."""


@dataclass(frozen=True, slots=True)
class FibreSensor(Sensor):
    """A camera behind a fibre: its noise as an operator passes it on."""

    noise_gains: tuple[float, float] = (1.0, 1.0)
    """``FibreOperator.noise_gains``."""

    def variance(self, bin_px: int) -> tuple[float, float]:
        """(slope, offset) of a sample's variance over its grey value; bins are the operator's affair."""
        read = (self.read_noise_electrons / self.electrons_per_grey) ** 2
        return self.noise_gains[0] / self.electrons_per_grey, self.noise_gains[1] * (read + ROUNDING)


class FibreOperator:
    """Call it with an image to fill a grid; all memory is taken at construction."""

    def __init__(self, core_map: CoreMap, grid_px: int, saturation_grey: float = 250.0) -> None:
        """``grid_px``: image pixels per grid step. A sample of a core with a pixel at ``saturation_grey`` or above
        becomes +inf."""
        height, width = core_map.flat.shape
        self.image_shape, self.shape = (height, width), (height // grid_px, width // grid_px)
        self._flat, self._limit = core_map.flat, saturation_grey
        spot = max(1, round(SPOT_SHARE * core_map.spacing_px))
        self._spot = spot
        corner = core_map.cores - 0.5 * (spot - 1)
        first = np.clip(np.floor(corner).astype(np.int64), 0, (width - fibre_light.WORD, height - spot - 1))
        self._first = (first[:, 1] * width + first[:, 0]).astype(np.uint32)
        self._fraction = np.ascontiguousarray(np.clip(corner - first, 0.0, 1.0).T, np.float32)
        self._cores = np.zeros(len(core_map.cores), np.float32)
        self._average(core_map.flat, math.inf)
        self.gain = self._cores / _smooth(core_map)
        """(n,) of each core's spot over the mean grey value of its surroundings."""
        self._spans, self._corners, self._weights = _triangles(core_map.cores, self.gain, self.shape, grid_px)
        spacing = core_map.spacing_px / grid_px
        self._near = sharpening(core_map.crosstalk, spacing, mixing(core_map.spacing_px, spot))
        self._tail = tail(core_map.crosstalk, spacing)
        self._take_memory()

    def _take_memory(self) -> None:
        rows, columns = self.shape
        self._cores = np.zeros(self._first.size, np.float32)
        self._grid = np.zeros((rows + 2 * REACH, columns + 2 * REACH), np.float32)
        self._saturated = np.zeros(self.shape, np.bool_)
        cells = -(-rows // CELL) + 2 * CELL_REACH, -(-columns // CELL) + 2 * CELL_REACH
        self._coarse = np.zeros((2, *cells), np.float32)
        self._rows = np.zeros((REACH + 1, columns + CELL + 2 * REACH), np.float32)

    def another(self) -> FibreOperator:
        """The same for another caller: with memory of its own."""
        other = copy(self)
        other._take_memory()
        return other

    @property
    def inside(self) -> NDArray[np.bool_]:
        """(rows, columns) of the grid: within the bundle."""
        column = np.arange(self.shape[1])
        return np.asarray((column >= self._spans[:, :1]) & (column < self._spans[:, 1:2]))

    def __call__(self, image: Image, out: NDArray[np.float32]) -> None:
        """(height, width) image -> out, ``shape``: local mean grey values, 0 outside the bundle."""
        if image.shape != self.image_shape or out.shape != self.shape:
            raise ValueError(f"the core map is of images {self.image_shape}, not {image.shape}")
        self._fill(image, self._limit, out)

    @cached_property
    def noise_gains(self) -> tuple[float, float]:
        """Variance of a sample per (grey value, 1) for pixels whose noise has the variance (grey value, 1).

        Neighbouring samples share cores, so means over them keep more noise than of separate pixels. Measured on
        noise that is sent through the operator, as a mean over ``NOISE_WINDOW`` sees it.
        """
        rng, quiet = np.random.default_rng(0), np.empty(self.shape, np.float32)
        self._fill(self._flat, math.inf, quiet)
        inner = ndimage.binary_erosion(self.inside, iterations=8)
        gains = []
        for spread, over in ((np.sqrt(self._flat), quiet), (np.ones_like(self._flat), np.ones_like(quiet))):
            noisy = np.empty_like(quiet)
            self._fill(self._flat + spread * rng.standard_normal(self._flat.shape, np.float32), math.inf, noisy)
            mean = ndimage.uniform_filter(noisy - quiet, NOISE_WINDOW)
            gains.append(math.prod(NOISE_WINDOW) * float(np.mean(mean[inner] ** 2 / over[inner])))
        return gains[0], gains[1]

    def _fill(self, image: NDArray[Any], limit: float, out: NDArray[np.float32]) -> None:
        self._average(image, limit)
        _interpolate(self._spans, self._corners, self._weights, self._cores, self._grid, self._saturated)
        _coarsen(self._grid, self._coarse[0])
        _spread(self._coarse[0], self._tail, self._coarse[1])
        _sharpen(self._grid, self._near, self._coarse[1], float(self._tail.sum()), self._spans, self._saturated,
                 self._rows, out)  # fmt: skip

    def _average(self, image: NDArray[Any], limit: float) -> None:
        place = self._first, self._fraction
        pixels = np.ascontiguousarray(image)
        fibre_light.average(pixels, self._spot, *place, limit, self._cores)
        fibre_light.complete(
            pixels.reshape(-1),
            self._flat.reshape(-1),
            self._spot,
            pixels.shape[1],
            *place,
            np.float32(limit),
            self._cores,
        )


def _smooth(core_map: CoreMap) -> NDArray[np.float32]:
    """(n,) mean grey value of the flat around each core."""
    side = max(1, round(core_map.spacing_px))
    height, width = (n // side for n in core_map.flat.shape)
    cells = core_map.flat[: height * side, : width * side].reshape(height, side, width, side).mean(axis=(1, 3))
    lit = (cells > LIT_SHARE * np.percentile(cells, 99)).astype(np.float32)
    wide = SMOOTH_SPACINGS * core_map.spacing_px / side
    mean = ndimage.gaussian_filter(cells * lit, wide) / np.maximum(ndimage.gaussian_filter(lit, wide), 1e-6)
    at = (core_map.cores[:, ::-1].T + 0.5) / side - 0.5
    return np.maximum(ndimage.map_coordinates(mean, at, order=1, mode="nearest"), np.float32(1e-6))


def _triangles(
    cores: NDArray[np.float64], gain: NDArray[np.float32], shape: tuple[int, int], grid_px: int
) -> tuple[NDArray[np.int64], NDArray[np.uint32], NDArray[np.float32]]:
    """Linear interpolation of the cores' light: row spans (rows, 2), then (3, n) cores and weights, row by row."""
    at = (cores + 0.5) / grid_px - 0.5
    corners = Delaunay(at).simplices
    # Slivers along the hull are wider than the mesh; they hold nothing that counts.
    extent = np.ptp(at[corners], axis=1).max(axis=1)
    corners = corners[extent < SLIVER * np.median(extent)]
    a, b, c = (at[corners[:, k]] for k in range(3))
    low = np.ceil(at[corners].min(axis=1)).astype(np.int64)
    reach = int(np.floor(np.ptp(at[corners], axis=1).max())) + 1
    step = np.stack(np.meshgrid(np.arange(reach), np.arange(reach)), axis=-1).reshape(-1, 2)
    # Every grid point in a triangle's box: its barycentric weights say whether it lies inside.
    point = low[:, None] + step
    x, y = np.moveaxis(point - a[:, None], -1, 0)
    (bx, by), (cx, cy) = (b - a).T[..., None], (c - a).T[..., None]
    double_area = bx * cy - by * cx
    of_b, of_c = (x * cy - y * cx) / double_area, (bx * y - by * x) / double_area
    share = np.stack((1.0 - of_b - of_c, of_b, of_c), axis=-1)
    inside = (share.min(axis=-1) > -1e-9) & (point >= 0).all(axis=-1) & (point < shape[::-1]).all(axis=-1)
    triangle, which = np.nonzero(inside)
    column, row = point[triangle, which].T
    cell = row * shape[1] + column
    corner, weight = np.zeros((math.prod(shape), 3), np.uint32), np.zeros((math.prod(shape), 3), np.float32)
    corner[cell] = corners[triangle]
    weight[cell] = share[triangle, which] / np.maximum(gain, GAIN_LEAST * np.median(gain))[corners[triangle]]
    # A row reaches from its first to its last point; one that no triangle holds stays dark.
    lit = np.bincount(cell, minlength=math.prod(shape)).reshape(shape) > 0
    end = np.where(lit.any(axis=1), shape[1] - lit[:, ::-1].argmax(axis=1), 0)
    spans = np.stack((np.where(end > 0, lit.argmax(axis=1), 0), end), axis=1)
    x = np.arange(shape[1])
    chosen = ((x >= spans[:, :1]) & (x < spans[:, 1:])).ravel()
    return spans, np.ascontiguousarray(corner[chosen].T), np.ascontiguousarray(weight[chosen].T)


@kernel
def _interpolate(
    spans: NDArray[np.int64],
    corners: NDArray[np.uint32],
    weights: NDArray[np.float32],
    cores: NDArray[np.float32],
    grid: NDArray[np.float32],
    saturated: NDArray[np.bool_],
) -> None:
    """Cores -> the inner part of ``grid`` (padded by ``REACH``), and where one of the three is marked."""
    zero, n = np.float32(0.0), 0
    for v in range(spans.shape[0]):
        begin, count = spans[v, 0], spans[v, 1] - spans[v, 0]
        row, marks = grid[v + REACH, begin + REACH :], saturated[v, begin:]
        i0, i1, i2 = corners[0, n : n + count], corners[1, n : n + count], corners[2, n : n + count]
        w0, w1, w2 = weights[0, n : n + count], weights[1, n : n + count], weights[2, n : n + count]
        n += count
        for x in range(i0.size):
            a, b, c = cores[i0[x]], cores[i1[x]], cores[i2[x]]
            row[x] = w0[x] * abs(a) + w1[x] * abs(b) + w2[x] * abs(c)
            marks[x] = min(a, min(b, c)) < zero


@kernel
def _coarsen(grid: NDArray[np.float32], coarse: NDArray[np.float32]) -> None:
    """Means over cells of ``CELL`` x ``CELL`` grid points; what is over at the right and the bottom is left out."""
    share = np.float32(1.0 / (CELL * CELL))
    rows, columns = (grid.shape[0] - 2 * REACH) // CELL, (grid.shape[1] - 2 * REACH) // CELL
    for v in range(rows):
        out = coarse[v + CELL_REACH, CELL_REACH : CELL_REACH + columns]
        out[:] = np.float32(0.0)
        for j in range(CELL):
            row = grid[v * CELL + j + REACH, REACH : REACH + CELL * columns]
            for x in range(columns):
                out[x] += row[CELL * x] + row[CELL * x + 1] + row[CELL * x + 2] + row[CELL * x + 3]
        for x in range(columns):
            out[x] *= share


@kernel
def _spread(coarse: NDArray[np.float32], weights: NDArray[np.float32], out: NDArray[np.float32]) -> None:
    """The tail's light in each cell."""
    size = weights.shape[0]
    for v in range(CELL_REACH, coarse.shape[0] - CELL_REACH):
        row = out[v, CELL_REACH : coarse.shape[1] - CELL_REACH]
        row[:] = np.float32(0.0)
        for j in range(size):
            line = coarse[v + j - CELL_REACH]
            for k in range(size):
                w, shifted = weights[j, k], line[k : k + row.size]
                for x in range(row.size):
                    row[x] += w * shifted[x]


@kernel
def _between(above: NDArray[np.float32], below: NDArray[np.float32], t: np.float32, row: NDArray[np.float32]) -> None:
    """A grid row of the bilinearly interpolated cells; ``row`` begins in the middle of the first cell."""
    quarter = np.float32(1.0 / CELL)
    step = np.float32(0.5) * quarter
    for q in range(min(above.size - 1, row.size // CELL)):
        a = above[q] + t * (below[q] - above[q])
        slope = above[q + 1] + t * (below[q + 1] - above[q + 1]) - a
        for k in range(CELL):
            row[CELL * q + k] = a + slope * (step + np.float32(k) * quarter)


@kernel
def _sharpen(
    grid: NDArray[np.float32],
    near: NDArray[np.float32],
    spread: NDArray[np.float32],
    tail_share: float,
    spans: NDArray[np.int64],
    saturated: NDArray[np.bool_],
    rows: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """(1 + tail) * near * grid - the tail's light, within the spans; +inf where marked. ``rows``: scratch."""
    zero, inf = np.float32(0.0), np.float32(np.inf)
    grown = np.float32(1.0 + tail_share)
    pairs, light = rows[0], rows[1]
    half = CELL // 2
    for v in range(out.shape[0]):
        begin, end = spans[v, 0], spans[v, 1]
        row = out[v]
        row[:] = zero
        if end <= begin:
            continue
        inner = row[begin:end]
        centre = v + REACH
        for j in range(REACH + 1):
            k0, k1, k2, k3 = near[j, 0], near[j, 1], near[j, 2], near[j, 3]
            above, below = grid[centre - j, begin : end + 2 * REACH], grid[centre + j, begin : end + 2 * REACH]
            share = np.float32(0.5) if j == 0 else np.float32(1.0)
            p = pairs[: above.size]
            for x in range(p.size):
                p[x] = share * (above[x] + below[x])
            for x in range(inner.size):
                inner[x] += (
                    k0 * p[x + 3] + k1 * (p[x + 2] + p[x + 4]) + k2 * (p[x + 1] + p[x + 5]) + k3 * (p[x] + p[x + 6])
                )
        # The cell rows whose middles lie above and below this grid row, from the middle of the last cell outside on.
        cell = (v + half) // CELL - 1 + CELL_REACH
        t = np.float32((np.float32((v + half) % CELL) + np.float32(0.5)) / np.float32(CELL))
        _between(spread[cell, CELL_REACH - 1 :], spread[cell + 1, CELL_REACH - 1 :], t, light)
        lost, marks = light[half + begin : half + end], saturated[v, begin:end]
        for x in range(inner.size):
            value = grown * inner[x] - lost[x]
            inner[x] = inf if marks[x] else value
