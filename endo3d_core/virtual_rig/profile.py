"""Extruded scenes: a profile of straight lines and arcs in (x, z), constant along y.

Every ray from one point of view crosses the profile's plane in a line through that point, so what the rays
hit is a function of their slope dx/dz alone. ``seen_from`` computes that function once per view in closed
form; casting a ray is then one look-up. z grows away from the sensor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from endo3d_core.compiled import exact, kernel

FAR_MM = np.float32(1e6)
"""The advance of a ray that hits nothing."""

LINE, ARC = 0.0, 1.0


@dataclass(frozen=True, eq=False)
class Profile:
    """Primitives of one connected or loose contour."""

    primitives: NDArray[np.float64]
    """(n, 7): LINE x0 z0 x1 z1 - - ; ARC cx cz radius middle half (rad, from the centre) side (1: convex)."""


@dataclass(frozen=True, eq=False)
class View:
    """What a point of view sees of a profile, per slope of the ray."""

    first_slope: float
    slopes_per_unit: float
    advance: NDArray[np.float32]
    """(n,) mm along z from the point to the surface; FAR_MM where nothing is."""
    nx: NDArray[np.float32]
    nz: NDArray[np.float32]
    """(n,) unit normal, facing the point of view."""


class Contour:
    """Draws a profile from left to right: lines, rounded corners, arcs. Heights point to the sensor."""

    def __init__(self, x_mm: float, height_mm: float) -> None:
        self._corners: list[tuple[float, float, float]] = [(x_mm, height_mm, 0.0)]
        self._primitives: list[tuple[float, ...]] = []

    def line(self, x_mm: float, height_mm: float, fillet_mm: float = 0.0) -> Contour:
        """A straight line to a point; ``fillet_mm`` rounds the corner there."""
        self._corners.append((x_mm, height_mm, fillet_mm))
        return self

    def cylinder(self, radius_mm: float, half_angle_deg: float) -> Contour:
        """A convex arc that begins here, symmetric about its crest, and ends on the same height."""
        self._flush()
        x, height, _ = self._corners[-1]
        half = math.radians(half_angle_deg)
        cx, cz = x + radius_mm * math.sin(half), -height + radius_mm * math.cos(half)
        self._primitives.append((ARC, cx, cz, radius_mm, -math.pi / 2, half, 1.0))
        self._corners = [(2 * cx - x, height, 0.0)]
        return self

    def profile(self, x_mm: float = 0.0, z_mm: float = 0.0) -> Profile:
        """The drawing, moved so that its origin lies at (x, z)."""
        self._flush()
        p = np.array(self._primitives, np.float64)
        p[:, 1] += x_mm
        p[:, 2] += z_mm
        lines = p[:, 0] == LINE
        p[lines, 3] += x_mm
        p[lines, 4] += z_mm
        return Profile(p)

    def _flush(self) -> None:
        """Turn the corners so far into lines and fillets."""
        points = [np.array((x, -height)) for x, height, _ in self._corners]
        start = points[0]
        for i in range(1, len(points)):
            end, radius = points[i], self._corners[i][2]
            if radius > 0.0 and i + 1 < len(points):
                a, b = _unit(points[i - 1] - end), _unit(points[i + 1] - end)
                half = math.acos(float(np.clip(a @ b, -1.0, 1.0))) / 2
                tangent = radius / math.tan(half)
                centre = end + _unit(a + b) * radius / math.sin(half)
                outward = end - centre
                self._line(start, end + a * tangent)
                angle = math.atan2(outward[1], outward[0])
                # Drawn from left to right, the line before the corner has the air on the side (-a_z, a_x).
                side = 1.0 if outward @ np.array((-a[1], a[0])) > 0.0 else -1.0
                self._primitives.append((ARC, *centre, radius, angle, math.pi / 2 - half, side))
                start = end + b * tangent
            else:
                self._line(start, end)
                start = end
        self._corners = self._corners[-1:]

    def _line(self, a: NDArray[np.float64], b: NDArray[np.float64]) -> None:
        if np.hypot(*(b - a)) > 1e-12:
            self._primitives.append((LINE, *a, *b, 0.0, 0.0))


def _unit(v: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(v / np.hypot(*v))


def seen_from(profile: Profile, x_mm: float, z_mm: float, slopes: tuple[float, float], count: int) -> View:
    """What the point (x, z) sees between two slopes, at ``count`` evenly spaced ones."""
    step = (slopes[1] - slopes[0]) / (count - 1)
    advance = np.full(count, FAR_MM, np.float32)
    nx, nz = np.zeros(count, np.float32), np.full(count, -1.0, np.float32)
    _look(profile.primitives, x_mm, z_mm, slopes[0], step, advance, nx, nz)
    return View(slopes[0], 1.0 / step, advance, nx, nz)


@exact
def _look(
    primitives: NDArray[np.float64],
    ox: float,
    oz: float,
    first: float,
    step: float,
    advance: NDArray[np.float32],
    nx: NDArray[np.float32],
    nz: NDArray[np.float32],
) -> None:
    for k in range(primitives.shape[0]):
        low, high = slope_range(primitives[k], ox, oz)
        begin = max(0, math.ceil((low - first) / step))
        end = min(advance.size - 1, math.floor((high - first) / step))
        for j in range(begin, end + 1):
            s, normal_x, normal_z = hit(primitives[k], ox, oz, first + j * step, 1.0)
            if s < advance[j]:
                advance[j], nx[j], nz[j] = s, normal_x, normal_z


@exact
def slope_range(primitive: NDArray[np.float64], ox: float, oz: float) -> tuple[float, float]:
    """Between which slopes dx/dz a point of view can meet a primitive that lies wholly before it."""
    ax, az = primitive[1] - ox, primitive[2] - oz
    if primitive[0] == LINE:
        bx, bz = primitive[3] - ox, primitive[4] - oz
        if az <= 0.0 or bz <= 0.0:
            return -np.inf, np.inf
        return min(ax / az, bx / bz), max(ax / az, bx / bz)
    spread = math.asin(min(1.0, primitive[3] / math.hypot(ax, az)))
    angle = math.atan2(ax, az)
    if abs(angle) + spread >= math.pi / 2:
        return -np.inf, np.inf
    return math.tan(angle - spread), math.tan(angle + spread)


@exact
def hit(primitive: NDArray[np.float64], ox: float, oz: float, dx: float, dz: float) -> tuple[float, float, float]:
    """Where the ray (ox, oz) + s (dx, dz) first meets a primitive: s (or infinity), the facing normal."""
    if primitive[0] == LINE:
        ax, az = primitive[1] - ox, primitive[2] - oz
        ex, ez = primitive[3] - primitive[1], primitive[4] - primitive[2]
        cross = dx * ez - dz * ex
        if cross == 0.0:
            return np.inf, 0.0, -1.0
        s = (ax * ez - az * ex) / cross
        along = (ax * dz - az * dx) / cross
        if s <= 0.0 or along < 0.0 or along > 1.0:
            return np.inf, 0.0, -1.0
        length = math.hypot(ex, ez)
        facing = -1.0 if cross > 0.0 else 1.0
        return s, facing * ez / length, -facing * ex / length
    cx, cz, radius = primitive[1] - ox, primitive[2] - oz, primitive[3]
    mid_x, mid_z, cos_half = math.cos(primitive[4]), math.sin(primitive[4]), math.cos(primitive[5])
    a = dx * dx + dz * dz
    b = dx * cx + dz * cz
    root = b * b - a * (cx * cx + cz * cz - radius * radius)
    if root < 0.0:
        return np.inf, 0.0, -1.0
    for sign in (-1.0, 1.0):
        s = (b + sign * math.sqrt(root)) / a
        px, pz = (s * dx - cx) / radius, (s * dz - cz) / radius
        if s > 0.0 and px * mid_x + pz * mid_z >= cos_half:
            facing = 1.0 if px * dx + pz * dz < 0.0 else -1.0
            return s, facing * px, facing * pz
    return np.inf, 0.0, -1.0


@exact
def cast_exact(
    primitives: NDArray[np.float64],
    T: NDArray[np.float64],
    rx: NDArray[np.float64],
    ry: NDArray[np.float64],
    z: NDArray[np.float64],
) -> None:
    """Lower ``z`` (n,) to the depths at which rays (rx, ry, 1) meet the profile; ``T`` = T_body_camera."""
    for i in range(rx.size):
        dx = T[0, 0] * rx[i] + T[0, 1] * ry[i] + T[0, 2]
        dz = T[2, 0] * rx[i] + T[2, 1] * ry[i] + T[2, 2]
        for k in range(primitives.shape[0]):
            s, _, _ = hit(primitives[k], T[0, 3], T[2, 3], dx, dz)
            if s < z[i]:
                z[i] = s


@exact
def distances(
    primitives: NDArray[np.float64], x: NDArray[np.float64], z: NDArray[np.float64], out: NDArray[np.float64]
) -> None:
    """Signed distances (n,) of points to the contour, positive on the sensor's side."""
    for i in range(x.size):
        nearest = np.inf
        for k in range(primitives.shape[0]):
            d = _distance(primitives[k], x[i], z[i])
            if abs(d) < abs(nearest):
                nearest = d
        out[i] = nearest


@exact
def _distance(primitive: NDArray[np.float64], x: float, z: float) -> float:
    if primitive[0] == LINE:
        ex, ez = primitive[3] - primitive[1], primitive[4] - primitive[2]
        px, pz = x - primitive[1], z - primitive[2]
        length2 = ex * ex + ez * ez
        t = min(max((px * ex + pz * ez) / length2, 0.0), 1.0)
        side = 1.0 if px * ez - pz * ex > 0.0 else -1.0
        return side * math.hypot(px - t * ex, pz - t * ez)
    px, pz, radius, middle, half = (
        x - primitive[1],
        z - primitive[2],
        primitive[3],
        primitive[4],
        primitive[5],
    )
    angle = math.atan2(pz, px) - middle
    angle -= 2.0 * math.pi * math.floor(angle / (2.0 * math.pi) + 0.5)
    side = primitive[6] if math.hypot(px, pz) > radius else -primitive[6]
    at = middle + min(max(angle, -half), half)
    return float(side * math.hypot(px - radius * math.cos(at), pz - radius * math.sin(at)))


@kernel
def cast(
    T: NDArray[np.float32],
    first: np.float32,
    per_unit: np.float32,
    advance: NDArray[np.float32],
    table_nx: NDArray[np.float32],
    table_nz: NDArray[np.float32],
    rx: NDArray[np.float32],
    ry: NDArray[np.float32],
    z: NDArray[np.float32],
    nx: NDArray[np.float32],
    ny: NDArray[np.float32],
    nz: NDArray[np.float32],
    body: NDArray[np.uint8],
    index: np.uint8,
) -> None:
    """Where the profile is nearer than ``z`` (n,), set depth, normal (camera's axes) and body."""
    last = np.float32(advance.size - 2)
    zero = np.float32(0.0)
    for i in range(rx.size):
        dx = T[0, 0] * rx[i] + T[0, 1] * ry[i] + T[0, 2]
        dz = T[2, 0] * rx[i] + T[2, 1] * ry[i] + T[2, 2]
        position = min(max((dx / dz - first) * per_unit, zero), last)
        j = np.uint32(position)
        f = position - np.float32(j)
        depth = (advance[j] + f * (advance[j + np.uint32(1)] - advance[j])) / dz
        bx = table_nx[j] + f * (table_nx[j + np.uint32(1)] - table_nx[j])
        bz = table_nz[j] + f * (table_nz[j + np.uint32(1)] - table_nz[j])
        nearer = depth < z[i]
        z[i] = depth if nearer else z[i]
        nx[i] = T[0, 0] * bx + T[2, 0] * bz if nearer else nx[i]
        ny[i] = T[0, 1] * bx + T[2, 1] * bz if nearer else ny[i]
        nz[i] = T[0, 2] * bx + T[2, 2] * bz if nearer else nz[i]
        body[i] = index if nearer else body[i]


@kernel
def shadow(
    T: NDArray[np.float32],
    px: np.float32,
    pz: np.float32,
    first: np.float32,
    per_unit: np.float32,
    advance: NDArray[np.float32],
    bias: np.float32,
    rx: NDArray[np.float32],
    ry: NDArray[np.float32],
    z: NDArray[np.float32],
    lit: NDArray[np.float32],
) -> None:
    """Clear ``lit`` (n,) where the projector at (px, pz) of the body's axes sees something nearer."""
    last = np.float32(advance.size - 2)
    zero = np.float32(0.0)
    for i in range(rx.size):
        x = (T[0, 0] * rx[i] + T[0, 1] * ry[i] + T[0, 2]) * z[i] + T[0, 3] - px
        h = (T[2, 0] * rx[i] + T[2, 1] * ry[i] + T[2, 2]) * z[i] + T[2, 3] - pz
        position = min(max((x / h - first) * per_unit, zero), last)
        j = np.uint32(position)
        f = position - np.float32(j)
        # The farther of both neighbours: a silhouette's step must not shadow its own edge.
        s = max(advance[j], advance[j + np.uint32(1)]) if f > zero else advance[j]
        lit[i] = lit[i] if h <= s + bias else zero
