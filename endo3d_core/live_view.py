"""A cloud made ready for registration and merging: pooled, gated, with normals, texture and scales of its own."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from endo3d_core import normals, pooling
from endo3d_core.compiled import kernel
from endo3d_core.grid_rays import GridRays, fit_grid_rays

POOL = 2
STEEPEST = 2.5
"""Slope up to which neighbouring cells count as one surface (68 deg)."""
TEXTURE_BOX = 1.0 / 10.0
"""Width of the texture's high-pass, in widths of the grid."""
_REFIT_GROWTH = 1.3
"""The rays are learnt again when a cloud has this many times more valid points than the one they came from."""


class LiveView:
    """Holds the arrays of one cloud at a time; nothing is allocated after the first."""

    def __init__(self) -> None:
        self.rays: GridRays | None = None
        self.count = 0
        """Valid pooled cells."""
        self._learnt_from = 0
        """Those of the cloud that the rays come from."""
        self.live = np.empty((pooling.PLANES, 0, 0), np.float32)
        """(PLANES, rows, columns) float32, see ``pooling``."""
        self.coefficients = np.zeros((2, 5), np.float32)
        """The pooled grid's rays."""
        self.sigma_mm = np.nan
        """Typical 1-sigma of a pooled point along its ray."""
        self.pitch_mm = np.nan
        """Typical distance of neighbouring pooled points."""

    def load(self, channels: NDArray[np.float32]) -> int:
        """(height, width, 6) float32 x y z intensity quality sigma -> the number of valid pooled cells.

        Raises ValueError when the cloud is not organised by rays, or too empty to tell.
        """
        known = self.rays is not None and self.rays.shape == channels.shape[:2]
        if not known or self._pool(channels) > _REFIT_GROWTH * self._learnt_from:
            self._learn_rays(channels)
        if self.count == 0:
            return 0
        assert self.rays is not None
        columns = self.live.shape[2]
        half = min(max(round(TEXTURE_BOX * columns / 2), 2), columns // 2)
        pooling.high_pass(self.live, half, self._work)
        self.pitch_mm = POOL * typical(self.live[pooling.Z], 1.0) / self.rays.focal_cells
        normals.slopes(self.live[pooling.Z], 2 * STEEPEST * self.pitch_mm, self._slopes)
        normals.orient(self._slopes, self.coefficients, typical(self.live[pooling.GREY], 1.0), self.live)
        self.sigma_mm = 1.0 / math.sqrt(typical(self.live[pooling.WEIGHT], 1.0))
        return self.count

    @property
    def normal_rad(self) -> float:
        """1-sigma of a normal's tilt from this one cloud."""
        return math.sqrt(normals.SLOPE_VARIANCE) * self.sigma_mm / self.pitch_mm

    @property
    def texture_noise(self) -> float:
        """1-sigma of a cell's texture, from second differences along and across: edges of the part run one way."""
        texture = self.live[pooling.TEXTURE]
        return 1.4826 / math.sqrt(6.0) * min(typical_bend(texture), typical_bend(texture.T))

    def points(self) -> NDArray[np.float64]:
        """(n, 3) float64 valid pooled points, mm in the camera's axes."""
        xyz = self.live[: pooling.Z + 1].reshape(3, -1)
        return np.ascontiguousarray(xyz[:, np.isfinite(xyz[pooling.Z])].T, np.float64)

    def _pool(self, channels: NDArray[np.float32]) -> int:
        assert self.rays is not None
        lines = channels.reshape(len(channels), -1)
        self.count = pooling.pool(lines, STEEPEST / self.rays.focal_cells, self._cells, self._weights, self.live)
        return self.count

    def _learn_rays(self, channels: NDArray[np.float32]) -> None:
        shape = channels.shape[:2]
        self.rays = fit_grid_rays(channels)
        self.coefficients = (self.rays.coefficients / POOL).astype(np.float32)
        self.coefficients[:, 0] -= np.float32(0.5 * (POOL - 1) / POOL)
        rows, columns = shape[0] // POOL, shape[1] // POOL
        self._cells, self._weights = np.empty((2, 5, pooling.SPAN), np.float32), np.empty((5, pooling.SPAN), np.float32)
        self._slopes = np.empty((2, rows, columns), np.float32)
        self._work = np.empty((4, columns + 1), np.float32)
        self.live = np.empty((pooling.PLANES, rows, columns), np.float32)
        self._learnt_from = self._pool(channels)


@kernel
def typical(plane: NDArray[np.float32], otherwise: float, stride: int = 8) -> float:
    """The median of every ``stride``th row and column, or ``otherwise`` where all is NaN."""
    values = np.empty((plane.shape[0] // stride + 1) * (plane.shape[1] // stride + 1), np.float32)
    n = 0
    for r in range(0, plane.shape[0], stride):
        for c in range(0, plane.shape[1], stride):
            values[n] = plane[r, c]
            n += 1 if values[n] == values[n] else 0
    return float(np.median(values[:n])) if n > 0 else otherwise


@kernel
def typical_bend(plane: NDArray[np.float32], stride: int = 4) -> float:
    """The median size of second differences along every ``stride``th row of (rows, columns)."""
    bends = np.empty(plane.size // stride + plane.shape[1], np.float32)
    n = 0
    for r in range(0, plane.shape[0], stride):
        for c in range(plane.shape[1] - 2):
            bends[n] = abs(plane[r, c] - np.float32(2.0) * plane[r, c + 1] + plane[r, c + 2])
            n += 1 if bends[n] == bends[n] else 0
    return float(np.median(bends[:n])) if n > 0 else np.inf
