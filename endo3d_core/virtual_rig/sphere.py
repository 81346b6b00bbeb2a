"""A sphere, cast in closed form."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from endo3d_core.compiled import exact, kernel


@exact
def cast_exact(
    radius: float,
    T: NDArray[np.float64],
    rx: NDArray[np.float64],
    ry: NDArray[np.float64],
    z: NDArray[np.float64],
) -> None:
    """Lower ``z`` (n,) float64 to the depth at which rays (rx, ry, 1) meet a sphere about the body's origin.

    ``T`` = T_body_camera.
    """
    for i in range(rx.size):
        dx = T[0, 0] * rx[i] + T[0, 1] * ry[i] + T[0, 2]
        dy = T[1, 0] * rx[i] + T[1, 1] * ry[i] + T[1, 2]
        dz = T[2, 0] * rx[i] + T[2, 1] * ry[i] + T[2, 2]
        a = dx * dx + dy * dy + dz * dz
        b = -(dx * T[0, 3] + dy * T[1, 3] + dz * T[2, 3])
        c = T[0, 3] ** 2 + T[1, 3] ** 2 + T[2, 3] ** 2 - radius * radius
        root = b * b - a * c
        if root >= 0.0:
            s = c / (b + math.sqrt(root))
            if 0.0 < s < z[i]:
                z[i] = s


@kernel
def cast(
    centre: NDArray[np.float32],
    radius: np.float32,
    rx: NDArray[np.float32],
    ry: NDArray[np.float32],
    z: NDArray[np.float32],
    nx: NDArray[np.float32],
    ny: NDArray[np.float32],
    nz: NDArray[np.float32],
    body: NDArray[np.uint8],
    index: np.uint8,
) -> None:
    """Where the sphere about ``centre`` (camera's axes) is nearer than ``z`` (n,): depth, normal, body.

    The root is taken of the squared distance between ray and centre, which float32 can hold; the textbook's
    discriminant b^2 - ac loses micrometres here.
    """
    one, zero = np.float32(1.0), np.float32(0.0)
    cx, cy, cz = centre[0], centre[1], centre[2]
    r2, inverse = radius * radius, one / radius
    for i in range(rx.size):
        a = rx[i] * rx[i] + ry[i] * ry[i] + one
        middle = (rx[i] * cx + ry[i] * cy + cz) / a
        ex, ey, ez = middle * rx[i] - cx, middle * ry[i] - cy, middle - cz
        inside = r2 - (ex * ex + ey * ey + ez * ez)
        depth = middle - np.float32(math.sqrt(max(inside, zero) / a))
        nearer = (inside >= zero) & (depth > zero) & (depth < z[i])
        z[i] = depth if nearer else z[i]
        nx[i] = (depth * rx[i] - cx) * inverse if nearer else nx[i]
        ny[i] = (depth * ry[i] - cy) * inverse if nearer else ny[i]
        nz[i] = (depth - cz) * inverse if nearer else nz[i]
        body[i] = index if nearer else body[i]


@kernel
def shadow(
    centre: NDArray[np.float32],
    radius: np.float32,
    lamp: NDArray[np.float32],
    bias: np.float32,
    rx: NDArray[np.float32],
    ry: NDArray[np.float32],
    z: NDArray[np.float32],
    lit: NDArray[np.float32],
) -> None:
    """Clear ``lit`` (n,) where the sphere stands between the point seen and the projector (``lamp``)."""
    cx, cy, cz = centre[0], centre[1], centre[2]
    px, py, pz = lamp[0], lamp[1], lamp[2]
    one, zero = np.float32(1.0), np.float32(0.0)
    limit = (radius - bias) * (radius - bias)
    for i in range(rx.size):
        lx, ly, lz = px - z[i] * rx[i], py - z[i] * ry[i], pz - z[i]
        qx, qy, qz = cx - z[i] * rx[i], cy - z[i] * ry[i], cz - z[i]
        t = min(max((lx * qx + ly * qy + lz * qz) / (lx * lx + ly * ly + lz * lz), zero), one)
        ex, ey, ez = qx - t * lx, qy - t * ly, qz - t * lz
        lit[i] = zero if ex * ex + ey * ey + ez * ez < limit else lit[i]
