"""From a surface point to the light that reaches the camera: projector model, light, reflection."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from endo3d_core.compiled import kernel


@kernel
def to_projector(
    lens: NDArray[np.float32],
    circle: NDArray[np.float32],
    R: NDArray[np.float32],
    t: NDArray[np.float32],
    rx: NDArray[np.float32],
    ry: NDArray[np.float32],
    z: NDArray[np.float32],
    u: NDArray[np.float32],
    v: NDArray[np.float32],
    depth: NDArray[np.float32],
    lit: NDArray[np.float32],
) -> None:
    """Projector pixel (u, v) and depth along the projector's axis of the points z (rx, ry, 1).

    ``lens``: fx, skew, cx, fy, cy, k1, k2, p1, p2, k3; ``circle``: what the projector's fibre sees of the
    pattern (centre u, v, squared radius), ``lit`` is cleared outside.
    """
    fx, skew, cx, fy, cy = lens[0], lens[1], lens[2], lens[3], lens[4]
    k1, k2, p1, p2, k3 = lens[5], lens[6], lens[7], lens[8], lens[9]
    zero, one, two = np.float32(0.0), np.float32(1.0), np.float32(2.0)
    for i in range(rx.size):
        x = z[i] * (R[0, 0] * rx[i] + R[0, 1] * ry[i] + R[0, 2]) + t[0]
        y = z[i] * (R[1, 0] * rx[i] + R[1, 1] * ry[i] + R[1, 2]) + t[1]
        h = z[i] * (R[2, 0] * rx[i] + R[2, 1] * ry[i] + R[2, 2]) + t[2]
        x, y = x / h, y / h
        r2 = x * x + y * y
        radial = one + r2 * (k1 + r2 * (k2 + r2 * k3))
        xd = x * radial + two * p1 * x * y + p2 * (r2 + two * x * x)
        yd = y * radial + p1 * (r2 + two * y * y) + two * p2 * x * y
        u[i] = fx * xd + skew * yd + cx
        v[i] = fy * yd + cy
        depth[i] = h
        du, dv = u[i] - circle[0], v[i] - circle[1]
        lit[i] = lit[i] if (h > zero) & (du * du + dv * dv <= circle[2]) else zero


@kernel
def sample(
    light: NDArray[np.float32],
    per_px: NDArray[np.float32],
    u: NDArray[np.float32],
    v: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Bilinear look-up in a (rows, columns) light at projector pixels; the edge continues outwards.

    ``per_px``: samples per projector pixel along u and v, and the sample index of pixel 0 (u, v); a light
    that does not vary along an axis has one sample there and 0 per pixel.
    """
    flat = light.reshape(-1)
    width = np.uint32(light.shape[1])
    zero = np.float32(0.0)
    last_u, last_v = np.float32(light.shape[1] - 1), np.float32(light.shape[0] - 1)
    step_u = np.uint32(1 if light.shape[1] > 1 else 0)
    step_v = np.uint32(light.shape[1] if light.shape[0] > 1 else 0)
    below_u, below_v = max(last_u - np.float32(1e-3), zero), max(last_v - np.float32(1e-3), zero)
    for i in range(u.size):
        x = min(max(u[i] * per_px[0] + per_px[2], zero), below_u)
        y = min(max(v[i] * per_px[1] + per_px[3], zero), below_v)
        ix, iy = np.uint32(x), np.uint32(y)
        fx, fy = x - np.float32(ix), y - np.float32(iy)
        at = iy * width + ix
        a = flat[at] + fx * (flat[at + step_u] - flat[at])
        b = flat[at + step_v] + fx * (flat[at + step_v + step_u] - flat[at + step_v])
        out[i] = a + fy * (b - a)


@kernel
def sample_levels(
    light: NDArray[np.float32],
    per_px: NDArray[np.float32],
    lens: NDArray[np.float32],
    focus: NDArray[np.float32],
    u: NDArray[np.float32],
    v: NDArray[np.float32],
    depth: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """The same in (levels, rows, columns), between levels linear in the variance of the blur.

    ``focus``: depth in focus on the axis, mm; its bow per squared slope; levels per mm out of focus.
    """
    flat = light.reshape(-1)
    width, plane = np.uint32(light.shape[2]), np.uint32(light.shape[1] * light.shape[2])
    one, zero = np.uint32(1), np.float32(0.0)
    below_u, below_v = (
        np.float32(light.shape[2]) - np.float32(1.01),
        np.float32(light.shape[1]) - np.float32(1.01),
    )
    last = np.float32(light.shape[0]) - np.float32(1.01)
    for i in range(u.size):
        sx, sy = (u[i] - lens[2]) / lens[0], (v[i] - lens[4]) / lens[3]
        off = np.float32(abs(depth[i] - focus[0] + focus[1] * (sx * sx + sy * sy))) * focus[2]
        off = min(off, last)
        level = np.uint32(off)
        low = np.float32(level)
        share = (off * off - low * low) / (low + low + np.float32(1.0))
        x = min(max(u[i] * per_px[0] + per_px[2], zero), below_u)
        y = min(max(v[i] * per_px[1] + per_px[3], zero), below_v)
        ix, iy = np.uint32(x), np.uint32(y)
        fx, fy = x - np.float32(ix), y - np.float32(iy)
        at = level * plane + iy * width + ix
        a = flat[at] + fx * (flat[at + one] - flat[at])
        b = flat[at + width] + fx * (flat[at + width + one] - flat[at + width])
        sharp = a + fy * (b - a)
        at += plane
        a = flat[at] + fx * (flat[at + one] - flat[at])
        b = flat[at + width] + fx * (flat[at + width + one] - flat[at + width])
        out[i] = sharp + share * (a + fy * (b - a) - sharp)


@kernel
def reflect(
    centre: NDArray[np.float32],
    axis: NDArray[np.float32],
    unit2: np.float32,
    ambient: np.float32,
    specular: np.float32,
    gloss: np.float32,
    rx: NDArray[np.float32],
    ry: NDArray[np.float32],
    z: NDArray[np.float32],
    nx: NDArray[np.float32],
    ny: NDArray[np.float32],
    nz: NDArray[np.float32],
    lit: NDArray[np.float32],
    light: NDArray[np.float32],
    albedo: NDArray[np.float32],
    body: NDArray[np.uint8],
    index: np.uint8,
    out: NDArray[np.float32],
) -> None:
    """Radiance towards the camera; 1: a white diffuse surface, upright, fully lit, at the working distance.

    ``centre``, ``axis``: of the projector in the camera's axes; ``unit2``: the squared distance at which the
    irradiance is 1; ``ambient``: a share of that, from everywhere.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    for i in range(rx.size):
        lx, ly, lz = centre[0] - z[i] * rx[i], centre[1] - z[i] * ry[i], centre[2] - z[i]
        l2 = lx * lx + ly * ly + lz * lz
        inverse = one / np.float32(math.sqrt(l2))
        lx, ly, lz = lx * inverse, ly * inverse, lz * inverse
        incidence = max(nx[i] * lx + ny[i] * ly + nz[i] * lz, zero)
        emission = max(-(lx * axis[0] + ly * axis[1] + lz * axis[2]), zero)
        irradiance = light[i] * lit[i] * incidence * emission * unit2 * inverse * inverse
        view = one / np.float32(math.sqrt(rx[i] * rx[i] + ry[i] * ry[i] + one))
        hx, hy, hz = lx - rx[i] * view, ly - ry[i] * view, lz - view
        half = max(nx[i] * hx + ny[i] * hy + nz[i] * hz, zero) / np.float32(
            math.sqrt(max(hx * hx + hy * hy + hz * hz, np.float32(1e-12)))
        )
        lobe = half / (gloss - gloss * half + half)
        radiance = albedo[i] * (irradiance + ambient) + specular * lobe * irradiance
        out[i] = radiance if body[i] == index else out[i]
