"""Brown-Conrady lens distortion of one point, compiled: for loops over pixels or rays.

Brown, "Close-range camera calibration", 1971; in OpenCV's form and order of coefficients (k1 k2 p1 p2 k3).
Everything is float64, coordinates are normalised (x = X/Z, y = Y/Z).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from endo3d_core.compiled import exact

NEWTON_STEPS = 20
"""More than ever needed: an endoscope's lens converges to 1e-14 in four."""


@exact
def distort(x: float, y: float, dist: NDArray[np.float64]) -> tuple[float, float]:
    """Where the lens moves the ideal point (x, y)."""
    k1, k2, p1, p2, k3 = dist[0], dist[1], dist[2], dist[3], dist[4]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
    )


@exact
def distort_jacobian(x: float, y: float, dist: NDArray[np.float64]) -> tuple[float, float, float]:
    """(dx'/dx, dx'/dy = dy'/dx, dy'/dy): the model's Jacobian is symmetric."""
    k1, k2, p1, p2, k3 = dist[0], dist[1], dist[2], dist[3], dist[4]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
    return (
        radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
        slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y,
        radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
    )


@exact
def undistort(u: float, v: float, dist: NDArray[np.float64]) -> tuple[float, float]:
    """The ideal point that the lens moves to (u, v), by Newton's method to float64's precision.

    (NaN, NaN) where the model folds over, i.e. no such point near (u, v) exists.
    """
    x, y = u, v
    for _ in range(NEWTON_STEPS):
        fx, fy = distort(x, y, dist)
        ex, ey = fx - u, fy - v
        a, b, d = distort_jacobian(x, y, dist)
        determinant = a * d - b * b
        if determinant <= 0.0:
            return np.nan, np.nan
        dx, dy = (d * ex - b * ey) / determinant, (a * ey - b * ex) / determinant
        x -= dx
        y -= dy
        if dx * dx + dy * dy < 1e-30:
            return x, y
    return np.nan, np.nan
