"""The rays of an organised cloud's grid, learnt from the cloud itself.

Every cell of the grid looks along one fixed ray, so x/z and y/z of its points say which. Fitting cell = f(x/z, y/z)
gives the projection that associates points with cells; no lens file is needed, and a decoder may bin and crop
as it likes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_ROBUST_ROUNDS = 3
_WORST_CELLS = 0.75
"""A larger mean misfit (in cells) means that the points do not lie on one ray per cell."""


@dataclass(frozen=True, slots=True)
class GridRays:
    """column = c . basis, row = d . basis with basis = (1, x, y, x r2, y r2) of x = X/Z, y = Y/Z."""

    coefficients: NDArray[np.float32]
    """(2, 5) float32: for the column, for the row."""
    shape: tuple[int, int]
    fitted_cells: int

    @property
    def focal_cells(self) -> float:
        """Cells per unit of x/z at the centre."""
        c = self.coefficients
        return float(np.sqrt(abs(np.linalg.det(c[:, 1:3].astype(np.float64)))))

    def pitch_mm(self, z_mm: float) -> float:
        """Distance of neighbouring points on a surface across the axis."""
        return z_mm / self.focal_cells


def fit_grid_rays(channels: NDArray[np.float32], stride: int = 3) -> GridRays:
    """From a cloud (height, width, >= 3) float32 with NaN where invalid.

    Raises ValueError when too few points are valid, or when the cloud is not organised by rays.
    """
    v, u = np.mgrid[0 : channels.shape[0] : stride, 0 : channels.shape[1] : stride].reshape(2, -1)
    p = channels[v, u, :3].astype(np.float64)
    valid = np.isfinite(p).all(axis=1) & (p[:, 2] > 0)
    if valid.sum() < 50:
        raise ValueError(f"{int(valid.sum())} valid points in every {stride}th row and column are too few")
    x, y = p[valid, 0] / p[valid, 2], p[valid, 1] / p[valid, 2]
    cells = np.column_stack([u[valid], v[valid]]).astype(np.float64)
    r2 = x * x + y * y
    basis = np.column_stack([np.ones_like(x), x, y, x * r2, y * r2])
    kept = np.ones(len(x), bool)
    for _ in range(_ROBUST_ROUNDS):
        coefficients = np.linalg.lstsq(basis[kept], cells[kept], rcond=None)[0]
        misfit = np.linalg.norm(basis @ coefficients - cells, axis=1)
        kept = misfit <= 4.0 * np.median(misfit) + 1e-6
    if np.median(misfit) > _WORST_CELLS:
        raise ValueError(
            f"the cloud is not organised by rays: its points lie {np.median(misfit):.1f} cells from where a lens "
            "would put them"
        )
    return GridRays(np.ascontiguousarray(coefficients.T, np.float32), channels.shape[:2], int(valid.sum()))
