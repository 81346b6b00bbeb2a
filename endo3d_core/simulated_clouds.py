"""Simulated organised clouds with known poses: what odometry is tested and measured on without a decoder.

A cloud is the exact intersection of the grid's rays with an analytic surface, plus white noise along the rays,
outliers and dropouts. There is no fibre, no fringe and no decoder here: ``virtual_rig`` has those.
Scenes lie near z = 0 of their own axes, their outside towards -z, where the camera is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d_core import rigid
from endo3d_core.compiled import kernel

Array = NDArray[np.float64]
LINE, ARC = 0.0, 1.0


@dataclass(frozen=True, slots=True)
class Profile:
    """A contour in (x, height), extruded along y: rows of LINE x0 h0 x1 h1 0 or ARC xc hc radius from to (rad)."""

    name: str
    parts: Array
    """(n, 6) float64."""

    def distance(self, points: Array) -> Array:
        """Signed distance (n,) mm of scene points (n, 3) to the contour, positive outside."""
        return np.asarray(_profile_distance(np.ascontiguousarray(points, np.float64), self.parts))


@dataclass(frozen=True, slots=True)
class Ball:
    """A sphere resting on a plane: its top ``height_mm`` above it."""

    name: str
    radius_mm: float
    height_mm: float

    def distance(self, points: Array) -> Array:
        centre = np.array([0.0, 0.0, self.radius_mm - self.height_mm])
        return np.asarray(np.minimum(np.linalg.norm(points - centre, axis=1) - self.radius_mm, -points[:, 2]))


@dataclass(frozen=True, slots=True)
class Quartic:
    """A smooth freeform: height = sum of c[i, j] x^i y^j."""

    name: str
    coefficients: Array
    """(5, 5) float64."""

    def distance(self, points: Array) -> Array:
        """First order: the vertical distance times the cosine of the slope."""
        x, y = points[:, 0], points[:, 1]
        polyval = np.polynomial.polynomial.polyval2d
        height = polyval(x, y, self.coefficients)
        slope_x = polyval(x, y, np.polynomial.polynomial.polyder(self.coefficients, axis=0))
        slope_y = polyval(x, y, np.polynomial.polynomial.polyder(self.coefficients, axis=1))
        return np.asarray((-points[:, 2] - height) / np.sqrt(1.0 + slope_x**2 + slope_y**2))


Scene = Profile | Ball | Quartic


def contour_standard() -> Profile:
    """Cylinders of radius 1.0 and 0.5 mm, steps of 1.0 and 0.5 mm, a 90 deg wedge, edges of 0.1 mm radius."""
    corners = [
        [(-12.0, 0.0, 0.0), (-4.5, 0.0, 0.0)],
        [(-2.5, 0.0, 0.0), (-1.5, 0.0, 0.0)],
        [
            (-0.5, 0.0, 0.0), (0.5, 0.0, 0.1), (0.5, 1.0, 0.1), (2.0, 1.0, 0.1), (2.0, 0.5, 0.1), (3.5, 0.5, 0.1),
            (3.5, 0.0, 0.1), (4.5, 0.0, 0.1), (5.5, 1.0, 0.1), (6.5, 0.0, 0.1), (15.0, 0.0, 0.0),
        ],
    ]  # fmt: skip
    parts = [part for chain in corners for part in _rounded(chain)]
    parts += [(ARC, -3.5, 0.0, 1.0, 0.0, np.pi), (ARC, -1.0, 0.0, 0.5, 0.0, np.pi)]
    return Profile("contour", np.array(parts))


def plane() -> Profile:
    return Profile("plane", np.array([(LINE, -50.0, 0.0, 50.0, 0.0, 0.0)]))


def ball_on_plane() -> Ball:
    return Ball("ball", radius_mm=2.0, height_mm=2.5)


def blade() -> Quartic:
    """Camber along x, twist and a bulge: no direction in which it maps onto itself."""
    c = np.zeros((5, 5))
    c[2, 0], c[0, 2], c[1, 1], c[3, 0], c[2, 1], c[1, 2], c[4, 0] = -0.05, -0.012, 0.03, 0.003, 0.004, -0.002, 2e-4
    return Quartic("blade", c)


SCENES: dict[str, Callable[[], Scene]] = {
    "contour": contour_standard,
    "blade": blade,
    "ball": ball_on_plane,
    "plane": plane,
}


@dataclass(frozen=True, slots=True)
class Sensor:
    """The grid of rays and its noise; the defaults are the registration study's."""

    width: int = 350
    height: int = 220
    working_distance_mm: float = 20.0
    field_mm: float = 12.0
    """Width of the grid at the working distance."""
    noise_mm: float = 0.010
    """1-sigma of z."""
    outlier_share: float = 0.01
    outlier_mm: float = 1.0
    """Outliers lie anywhere within +- this of the surface."""
    grey: float = 100.0
    grey_noise: float = 1.0
    texture: float = 0.15
    """Standard deviation of the albedo over its mean."""
    circle: bool = False
    """Only the image circle of a fibre is valid."""

    @property
    def focal_px(self) -> float:
        return self.width * self.working_distance_mm / self.field_mm


@dataclass(frozen=True, slots=True)
class HandMotion:
    """A hand-guided path: slow drift, tremor of 8..12 Hz, small rotations (seeded sums of sines)."""

    seed: int = 1
    drift_mm_s: float = 3.0
    tremor_mm: float = 0.075
    reach_mm: tuple[float, float] = (3.0, 1.5)
    """The drift's half range along x and y."""
    centre_mm: tuple[float, float] = (0.0, 0.0)
    working_distance_mm: float = 20.0
    _phases: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_phases", np.random.default_rng(self.seed).uniform(0, 2 * np.pi, (6, 4)))

    def pose(self, t_s: float) -> Array:
        """T_scene_camera (4, 4)."""
        p = self._phases
        # Drift along x crosses its range at the drift's speed; y and z wander more slowly.
        turn = self.drift_mm_s / max(self.reach_mm[0], 0.5)
        x = self.centre_mm[0] + self.reach_mm[0] * np.sin(turn * t_s)
        y = self.centre_mm[1] + self.reach_mm[1] * np.sin(0.37 * turn * t_s + p[1, 0])
        z = 0.4 * np.sin(0.61 * turn * t_s + p[2, 0])
        tremor = np.array([
            0.5 * np.sin(2 * np.pi * f * t_s + p[axis, 1 + i])
            for axis in range(3)
            for i, f in enumerate((8.3 + 0.4 * axis, 11.6 - 0.5 * axis))
        ]).reshape(3, 2).sum(axis=1)  # fmt: skip
        angles = [
            0.03 * np.sin((0.4 + 0.13 * axis) * turn * t_s + p[3 + axis, 0])
            + 0.002 * np.sin(2 * np.pi * (9.1 + 0.7 * axis) * t_s + p[3 + axis, 1])
            for axis in range(3)
        ]
        T = np.eye(4)
        T[:3, :3] = rigid.rotation_exp(angles)
        T[:3, 3] = np.array([x, y, z - self.working_distance_mm]) + self.tremor_mm * tremor
        return T


@dataclass(frozen=True, slots=True)
class SimulatedCloud:
    sequence: int
    stamp_ns: int
    channels: NDArray[np.float32]
    """(height, width, 6) float32: x, y, z, intensity, quality, sigma; NaN where invalid."""
    T_scene_camera: Array


def clouds(
    scene: Scene,
    motion: HandMotion,
    duration_s: float,
    rate_hz: float = 172.0,
    sensor: Sensor | None = None,
    seed: int = 0,
) -> Iterator[SimulatedCloud]:
    """The scan, cloud by cloud; the same arguments give the same clouds."""
    sensor = sensor or Sensor()
    caster = Caster(scene, sensor, seed)
    for sequence in range(round(duration_s * rate_hz)):
        t_s = sequence / rate_hz
        T = motion.pose(t_s)
        yield SimulatedCloud(sequence, round(1e9 * t_s), caster.cast(T, sequence), T)


class Caster:
    """Casts the sensor's grid onto a scene."""

    def __init__(self, scene: Scene, sensor: Sensor, seed: int = 0) -> None:
        self.scene, self.sensor, self.seed = scene, sensor, seed
        v, u = np.mgrid[: sensor.height, : sensor.width].astype(np.float64)
        rays = np.ones((sensor.height, sensor.width, 3))
        rays[..., 0] = (u - (sensor.width - 1) / 2) / sensor.focal_px
        rays[..., 1] = (v - (sensor.height - 1) / 2) / sensor.focal_px
        self.rays = rays
        self.texture = _texture(sensor.texture)
        self.outside = np.zeros(rays.shape[:2], bool)
        if sensor.circle:
            radius = min(sensor.width, sensor.height) / 2
            self.outside = np.hypot(*(rays[..., :2].transpose(2, 0, 1) * sensor.focal_px)) > radius

    def cast(self, T_scene_camera: Array, sequence: int = 0) -> NDArray[np.float32]:
        """(height, width, 6) float32; noise is drawn from (seed, sequence)."""
        rng = np.random.default_rng([self.seed, sequence])
        shape, sensor = self.rays.shape[:2], self.sensor
        depth, shade = self._surface(T_scene_camera)
        depth += sensor.noise_mm * rng.standard_normal(shape, np.float32)
        out = rng.random(shape, np.float32) < sensor.outlier_share
        depth[out] += rng.uniform(-sensor.outlier_mm, sensor.outlier_mm, int(out.sum()))
        depth[self.outside] = np.nan
        cloud = np.empty((*shape, 6), np.float32)
        cloud[..., :3] = self.rays * depth[..., None]
        cloud[..., 3] = sensor.grey * shade + sensor.grey_noise * rng.standard_normal(shape, np.float32)
        cloud[..., 4] = 1.0
        cloud[..., 5] = sensor.noise_mm
        cloud[np.isnan(depth)] = np.nan
        return cloud

    def _surface(self, T: Array) -> tuple[Array, Array]:
        depth, shade = np.empty(self.rays.shape[:2]), np.empty(self.rays.shape[:2])
        directions = np.ascontiguousarray(self.rays @ T[:3, :3].T)
        origin = np.ascontiguousarray(T[:3, 3])
        match self.scene:
            case Profile(parts=parts):
                _cast_profile(origin, directions, parts, self.texture, depth, shade)
            case Ball(radius_mm=radius, height_mm=height):
                _cast_ball(origin, directions, radius, height, self.texture, depth, shade)
            case Quartic(coefficients=c):
                _cast_quartic(origin, directions, np.ascontiguousarray(c), self.texture, depth, shade)
        # One unit of ray is one mm of z; brightness falls with the square of the distance from the tip.
        shade *= (self.sensor.working_distance_mm / depth) ** 2
        return depth, shade


TEXEL_MM = 0.02


def _texture(contrast: float) -> NDArray[np.float32]:
    """(512, 512) float32 albedo, periodic, mean 1, detail of 0.1 to 1 mm; the same piece of metal every time."""
    rng = np.random.default_rng(20180101)
    f = np.fft.fftfreq(512, TEXEL_MM)
    f_per_mm = np.hypot(f[:, None], f[None, :])
    spectrum = np.fft.fft2(rng.standard_normal((512, 512)))
    band = np.where(f_per_mm > 0, np.exp(-((f_per_mm / 4.0) ** 2)) / np.maximum(f_per_mm, 0.5), 0.0)
    pattern = np.real(np.fft.ifft2(spectrum * band))
    return np.asarray(1.0 + contrast * pattern / pattern.std(), np.float32)


def _rounded(corners: list[tuple[float, float, float]]) -> list[tuple[float, ...]]:
    """Lines through (x, height, radius) corners, with an arc of that radius at each."""
    parts: list[tuple[float, ...]] = []
    x0, h0, _ = corners[0]
    for (xa, ha, radius), (xb, hb, _) in zip(corners[1:], [*corners[2:], corners[-1]], strict=True):
        corner, before, after = np.array([xa, ha]), np.array([x0 - xa, h0 - ha]), np.array([xb - xa, hb - ha])
        if radius == 0.0:
            parts.append((LINE, x0, h0, xa, ha, 0.0))
            continue
        before, after = before / np.linalg.norm(before), after / np.linalg.norm(after)
        half = np.arccos(np.clip(before @ after, -1, 1)) / 2
        a, b = corner + before * radius / np.tan(half), corner + after * radius / np.tan(half)
        centre = corner + (before + after) / np.linalg.norm(before + after) * radius / np.sin(half)
        start, end = (float(np.arctan2(*(p - centre)[::-1])) for p in (a, b))
        turn = (end - start + np.pi) % (2 * np.pi) - np.pi
        parts.append((LINE, x0, h0, float(a[0]), float(a[1]), 0.0))
        parts.append(
            (ARC, float(centre[0]), float(centre[1]), radius, min(start, start + turn), max(start, start + turn))
        )
        x0, h0 = float(b[0]), float(b[1])
    return parts


@kernel
def _albedo(texture: Any, x: Any, y: Any) -> Any:
    u, v = x / TEXEL_MM, y / TEXEL_MM
    i, j = int(np.floor(u)), int(np.floor(v))
    a, b = u - i, v - j
    n = texture.shape[0]
    i0, j0, i1, j1 = i % n, j % n, (i + 1) % n, (j + 1) % n
    top = (1 - a) * texture[j0, i0] + a * texture[j0, i1]
    return (1 - b) * top + b * ((1 - a) * texture[j1, i0] + a * texture[j1, i1])


@kernel
def _cast_profile(origin: Any, directions: Any, parts: Any, texture: Any, depth: Any, shade: Any) -> Any:
    ox, oh = origin[0], -origin[2]
    for r in range(depth.shape[0]):
        for c in range(depth.shape[1]):
            dx, dy, dh = directions[r, c, 0], directions[r, c, 1], -directions[r, c, 2]
            best, nx, nh, along = np.inf, 0.0, 0.0, 0.0
            for k in range(parts.shape[0]):
                if parts[k, 0] == LINE:
                    ex, eh = parts[k, 3] - parts[k, 1], parts[k, 4] - parts[k, 2]
                    det = dh * ex - dx * eh
                    if det == 0.0:
                        continue
                    fx, fh = parts[k, 1] - ox, parts[k, 2] - oh
                    s, t = (ex * fh - eh * fx) / det, (dx * fh - dh * fx) / det
                    if 0.0 <= t <= 1.0 and 0.0 < s < best:
                        length = np.sqrt(ex * ex + eh * eh)
                        best, nx, nh, along = s, -eh / length, ex / length, ox + s * dx - (oh + s * dh)
                else:
                    fx, fh, radius = ox - parts[k, 1], oh - parts[k, 2], parts[k, 3]
                    aa, bb = dx * dx + dh * dh, fx * dx + fh * dh
                    disc = bb * bb - aa * (fx * fx + fh * fh - radius * radius)
                    if disc <= 0.0:
                        continue
                    for sign in (-1.0, 1.0):
                        s = (-bb + sign * np.sqrt(disc)) / aa
                        px, ph = fx + s * dx, fh + s * dh
                        angle = np.arctan2(ph, px)
                        low, high = parts[k, 4], parts[k, 5]
                        inside = (
                            low <= angle <= high or low <= angle + 2 * np.pi <= high or low <= angle - 2 * np.pi <= high
                        )
                        if inside and 0.0 < s < best:
                            best, nx, nh, along = s, px / radius, ph / radius, ox + s * dx - (oh + s * dh)
            depth[r, c] = best if best < np.inf else np.nan
            length = np.sqrt(dx * dx + dy * dy + dh * dh)
            cosine = abs(nx * dx + nh * dh) / length
            shade[r, c] = cosine * _albedo(texture, along, origin[1] + best * dy) if best < np.inf else np.nan


@kernel
def _cast_ball(origin: Any, directions: Any, radius: Any, height: Any, texture: Any, depth: Any, shade: Any) -> Any:
    fz = origin[2] - (radius - height)
    ff = origin[0] * origin[0] + origin[1] * origin[1] + fz * fz - radius * radius
    for r in range(depth.shape[0]):
        for c in range(depth.shape[1]):
            dx, dy, dz = directions[r, c, 0], directions[r, c, 1], directions[r, c, 2]
            length = np.sqrt(dx * dx + dy * dy + dz * dz)
            aa, bb = length * length, origin[0] * dx + origin[1] * dy + fz * dz
            disc = bb * bb - aa * ff
            s = -origin[2] / dz
            cosine = dz / length
            if disc > 0.0:
                near = (-bb - np.sqrt(disc)) / aa
                if near < s:
                    s = near
                    px, py, pz = origin[0] + s * dx, origin[1] + s * dy, fz + s * dz
                    cosine = -(px * dx + py * dy + pz * dz) / (radius * length)
            x, y, z = origin[0] + s * dx, origin[1] + s * dy, origin[2] + s * dz
            depth[r, c] = s
            shade[r, c] = cosine * _albedo(texture, x + z, y)


@kernel
def _cast_quartic(origin: Any, directions: Any, coefficients: Any, texture: Any, depth: Any, shade: Any) -> Any:
    for r in range(depth.shape[0]):
        for c in range(depth.shape[1]):
            dx, dy, dz = directions[r, c, 0], directions[r, c, 1], directions[r, c, 2]
            s = -origin[2] / dz
            nx, ny = 0.0, 0.0
            for _ in range(6):
                x, y = origin[0] + s * dx, origin[1] + s * dy
                height, nx, ny = 0.0, 0.0, 0.0
                xi = 1.0
                for i in range(5):
                    yj = 1.0
                    for j in range(5):
                        height += coefficients[i, j] * xi * yj
                        if i < 4:
                            nx += (i + 1) * coefficients[i + 1, j] * xi * yj
                        if j < 4:
                            ny += (j + 1) * coefficients[i, j + 1] * xi * yj
                        yj *= y
                    xi *= x
                gap = origin[2] + s * dz + height
                s -= gap / (dz + nx * dx + ny * dy)
            length = np.sqrt(dx * dx + dy * dy + dz * dz) * np.sqrt(1.0 + nx * nx + ny * ny)
            depth[r, c] = s
            cosine = (dz + nx * dx + ny * dy) / length
            shade[r, c] = cosine * _albedo(texture, origin[0] + s * dx, origin[1] + s * dy)


@kernel
def _profile_distance(points: Any, parts: Any) -> Any:
    out = np.empty(points.shape[0])
    for i in range(points.shape[0]):
        x, h = points[i, 0], -points[i, 2]
        best, signed = np.inf, np.nan
        for k in range(parts.shape[0]):
            if parts[k, 0] == LINE:
                ex, eh = parts[k, 3] - parts[k, 1], parts[k, 4] - parts[k, 2]
                length = np.sqrt(ex * ex + eh * eh)
                t = ((x - parts[k, 1]) * ex + (h - parts[k, 2]) * eh) / (length * length)
                t = min(max(t, 0.0), 1.0)
                gx, gh = x - parts[k, 1] - t * ex, h - parts[k, 2] - t * eh
                gap = np.sqrt(gx * gx + gh * gh)
                value = gap if ex * gh - eh * gx >= 0.0 else -gap
            else:
                fx, fh = x - parts[k, 1], h - parts[k, 2]
                angle = np.arctan2(fh, fx)
                low, high = parts[k, 4], parts[k, 5]
                if not (low <= angle <= high or low <= angle + 2 * np.pi <= high or low <= angle - 2 * np.pi <= high):
                    continue
                value = np.sqrt(fx * fx + fh * fh) - parts[k, 3]
                # A fillet's arc below its chord is concave: the outside is towards its centre.
                if np.sin((low + high) / 2) < 0.0:
                    value = -value
                gap = abs(value)
            if gap < best:
                best, signed = gap, value
        out[i] = signed
    return out
