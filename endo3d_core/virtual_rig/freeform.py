"""A freeform surface like a turbine blade's: cambered, bowed and twisted, z = f(x, y) within an outline."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from endo3d_core.compiled import exact, kernel

CHORD_MM, SPAN_MM = 10.0, 16.0
"""The outline: a rectangle along x and y."""
BLADE = (0.035, 0.004, 0.0012, 0.020, 0.035)
"""f = a x^2 + b x^3 + c x^4 + d y^2 + e x y, mm. Convex towards the sensor, so it throws no shadow on itself."""

NEWTON_STEPS = 8


def blade(size: float) -> NDArray[np.float64]:
    """(7,) coefficients and half outline of a blade of that size (1: a chord of 10 mm)."""
    a, b, c, d, e = BLADE
    shape = (a / size, b / size**2, c / size**3, d / size, e / size)
    return np.array((*shape, CHORD_MM / 2 * size, SPAN_MM / 2 * size))


@exact
def _height(p: NDArray[np.float64], x: float, y: float) -> tuple[float, float, float]:
    """f and its slopes."""
    f = x * x * (p[0] + x * (p[1] + x * p[2])) + p[3] * y * y + p[4] * x * y
    return f, x * (2 * p[0] + x * (3 * p[1] + x * 4 * p[2])) + p[4] * y, 2 * p[3] * y + p[4] * x


@exact
def cast_exact(
    p: NDArray[np.float64],
    T: NDArray[np.float64],
    rx: NDArray[np.float64],
    ry: NDArray[np.float64],
    z: NDArray[np.float64],
) -> None:
    """Lower ``z`` (n,) to the depths at which rays (rx, ry, 1) meet the surface; ``T`` = T_body_camera."""
    for i in range(rx.size):
        dx = T[0, 0] * rx[i] + T[0, 1] * ry[i] + T[0, 2]
        dy = T[1, 0] * rx[i] + T[1, 1] * ry[i] + T[1, 2]
        dz = T[2, 0] * rx[i] + T[2, 1] * ry[i] + T[2, 2]
        s = -T[2, 3] / dz
        step = np.inf
        for _ in range(50):
            f, fx, fy = _height(p, T[0, 3] + s * dx, T[1, 3] + s * dy)
            step = (T[2, 3] + s * dz - f) / (dz - fx * dx - fy * dy)
            s -= step
            if abs(step) < 1e-13 * abs(s):
                break
        x, y = T[0, 3] + s * dx, T[1, 3] + s * dy
        if abs(step) < 1e-9 and 0.0 < s < z[i] and abs(x) <= p[5] and abs(y) <= p[6]:
            z[i] = s


@kernel
def cast(
    p: NDArray[np.float32],
    T: NDArray[np.float32],
    rx: NDArray[np.float32],
    ry: NDArray[np.float32],
    z: NDArray[np.float32],
    nx: NDArray[np.float32],
    ny: NDArray[np.float32],
    nz: NDArray[np.float32],
    body: NDArray[np.uint8],
    index: np.uint8,
) -> None:
    """Where the surface is nearer than ``z`` (n,), set depth, normal (camera's axes) and body."""
    two, three, four, one = np.float32(2.0), np.float32(3.0), np.float32(4.0), np.float32(1.0)
    for i in range(rx.size):
        dx = T[0, 0] * rx[i] + T[0, 1] * ry[i] + T[0, 2]
        dy = T[1, 0] * rx[i] + T[1, 1] * ry[i] + T[1, 2]
        dz = T[2, 0] * rx[i] + T[2, 1] * ry[i] + T[2, 2]
        s = -T[2, 3] / dz
        x, y, fx, fy, off = s, s, s, s, s
        for _ in range(NEWTON_STEPS):
            x, y = T[0, 3] + s * dx, T[1, 3] + s * dy
            f = x * x * (p[0] + x * (p[1] + x * p[2])) + p[3] * y * y + p[4] * x * y
            fx = x * (two * p[0] + x * (three * p[1] + x * four * p[2])) + p[4] * y
            fy = two * p[3] * y + p[4] * x
            off = T[2, 3] + s * dz - f
            s -= off / (dz - fx * dx - fy * dy)
        inverse = one / np.float32(math.sqrt(fx * fx + fy * fy + one))
        there = (abs(x) <= p[5]) & (abs(y) <= p[6]) & (abs(off) < np.float32(1e-3))
        nearer = there & (s > np.float32(0.0)) & (s < z[i])
        z[i] = s if nearer else z[i]
        nx[i] = (T[0, 0] * fx + T[1, 0] * fy - T[2, 0]) * inverse if nearer else nx[i]
        ny[i] = (T[0, 1] * fx + T[1, 1] * fy - T[2, 1]) * inverse if nearer else ny[i]
        nz[i] = (T[0, 2] * fx + T[1, 2] * fy - T[2, 2]) * inverse if nearer else nz[i]
        body[i] = index if nearer else body[i]


@exact
def distances(p: NDArray[np.float64], points: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Signed distances (n,) of points (n, 3) near the surface, positive on the sensor's side."""
    for i in range(points.shape[0]):
        x, y, f, fx, fy = points[i, 0], points[i, 1], 0.0, 0.0, 0.0
        for _ in range(30):  # the foot of the perpendicular: again and again that on the tangent plane
            f, fx, fy = _height(p, x, y)
            above = points[i, 2] - f - fx * (points[i, 0] - x) - fy * (points[i, 1] - y)
            above /= 1.0 + fx * fx + fy * fy
            x = min(max(points[i, 0] + above * fx, -p[5]), p[5])
            y = min(max(points[i, 1] + above * fy, -p[6]), p[6])
        f, fx, fy = _height(p, x, y)
        gap = points[i, 2] - f
        side = -1.0 if gap > 0.0 else 1.0
        out[i] = side * math.sqrt((points[i, 0] - x) ** 2 + (points[i, 1] - y) ** 2 + gap * gap)
