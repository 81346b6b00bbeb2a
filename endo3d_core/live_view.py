"""A cloud made ready for registration and merging: pooled, gated, with normals, texture and scales of its own."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from endo3d_core import normals, pooling
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
        self.live = np.empty((0, 0, normals.LIVE), np.float32)
        """(rows, columns, LIVE) float32, see ``normals``."""
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
        self._learn_rays(channels)
        assert self.rays is not None
        pitch_mm = _typical(channels[..., 2]) / self.rays.focal_cells
        self.count = pooling.pool(channels, STEEPEST * pitch_mm, self._planes)
        if self.count == 0:
            return 0
        half = max(round(TEXTURE_BOX * self.live.shape[1] / 2), 2)
        pooling.high_pass(self._planes, half, self._work)
        self.pitch_mm = POOL * pitch_mm
        normals.slopes(self._planes[pooling.Z], 2 * STEEPEST * self.pitch_mm, self._slopes)
        grey = _typical(self._planes[pooling.INTENSITY])
        normals.gather(self._planes, self._slopes, self.coefficients, grey, self.live)
        self.sigma_mm = _typical(self._planes[pooling.SIGMA])
        return self.count

    @property
    def normal_rad(self) -> float:
        """1-sigma of a normal's tilt from this one cloud."""
        return float(np.sqrt(normals.SLOPE_VARIANCE)) * self.sigma_mm / self.pitch_mm

    def _learn_rays(self, channels: NDArray[np.float32]) -> None:
        shape = channels.shape[:2]
        if self.rays is not None and self.rays.shape == shape:
            valid = int(np.isfinite(channels[::3, ::3, 2]).sum())
            if valid <= _REFIT_GROWTH * self.rays.fitted_cells:
                return
        self.rays = fit_grid_rays(channels)
        self.coefficients = (self.rays.coefficients / POOL).astype(np.float32)
        self.coefficients[:, 0] -= np.float32(0.5 * (POOL - 1) / POOL)
        rows, columns = shape[0] // POOL, shape[1] // POOL
        self._planes = np.empty((pooling.PLANES, rows, columns), np.float32)
        self._slopes = np.empty((2, rows, columns), np.float32)
        self._work = np.empty((4, columns + 1), np.float64)
        self.live = np.empty((rows, columns, normals.LIVE), np.float32)


def _typical(plane: NDArray[np.float32], stride: int = 8) -> float:
    """The median of every ``stride``th row and column, or 1 where all is NaN."""
    values = plane[::stride, ::stride].ravel()
    values = values[values == values]
    return float(np.median(values)) if values.size else 1.0
