"""Feature fits and deviations: plane, sphere, cylinder, step height, wedge angle.

Sizes and forms as the paper states them (Tables 3 and 5): the size is the fitted parameter, the form is the
standard deviation of the distances to the fit. Planes by iteratively reweighted least squares, spheres and
cylinders by ``scipy.optimize.least_squares`` with the soft-L1 loss at the scale of the data's own noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

_MAD_TO_SIGMA = 1.4826
_TUKEY = 4.685
"""95 % efficiency on normal noise (Huber, Robust Statistics)."""
_RESOLUTION_MM = 1e-6
"""Far below any noise: keeps the robust scale of exact points from being zero."""


@dataclass(frozen=True, slots=True)
class Plane:
    """Points p with normal . p = offset."""

    normal: NDArray[np.float64]
    offset_mm: float
    form_um: float
    count: int

    def distance(self, points: ArrayLike) -> NDArray[np.float64]:
        """Signed distances (n,) mm."""
        distance: NDArray[np.float64] = np.asarray(points, np.float64) @ self.normal - self.offset_mm
        return distance


@dataclass(frozen=True, slots=True)
class Sphere:
    centre: NDArray[np.float64]
    radius_mm: float
    form_um: float
    count: int

    def distance(self, points: ArrayLike) -> NDArray[np.float64]:
        """Signed distances (n,) mm, positive outside."""
        relative = np.asarray(points, np.float64) - self.centre
        return np.asarray(np.linalg.norm(relative, axis=1) - self.radius_mm)


@dataclass(frozen=True, slots=True)
class Cylinder:
    centre: NDArray[np.float64]
    """A point of the axis."""
    axis: NDArray[np.float64]
    radius_mm: float
    form_um: float
    count: int

    def distance(self, points: ArrayLike) -> NDArray[np.float64]:
        """Signed distances (n,) mm, positive outside."""
        relative = np.asarray(points, np.float64) - self.centre
        across = relative - np.outer(relative @ self.axis, self.axis)
        return np.asarray(np.linalg.norm(across, axis=1) - self.radius_mm)


def fit_plane(points: ArrayLike) -> Plane:
    """The plane of points (n, 3) mm; outliers lose their weight (Tukey)."""
    points = _finite(points, 3)
    weights = np.ones(len(points))
    for _ in range(20):
        centre = np.average(points, axis=0, weights=weights)
        _, _, Vt = np.linalg.svd(np.sqrt(weights)[:, None] * (points - centre), full_matrices=False)
        distance = (points - centre) @ Vt[2]
        reach = _TUKEY * max(_noise(distance), _RESOLUTION_MM)
        weights = np.where(np.abs(distance) < reach, (1.0 - (distance / reach) ** 2) ** 2, 0.0)
    return Plane(Vt[2], float(centre @ Vt[2]), _form_um(distance), len(points))


def fit_sphere(points: ArrayLike, radius_mm: float | None = None) -> Sphere:
    """The sphere of points (n, 3) mm; with ``radius_mm`` only its centre is fitted."""
    points = _finite(points, 4)
    centre, radius = _algebraic_ball(points)
    fixed = radius_mm is not None

    def residual(p: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.linalg.norm(points - p[:3], axis=1) - (radius_mm if fixed else p[3]))

    best = _soft(residual, centre if fixed else np.append(centre, radius))
    size = float(radius_mm) if radius_mm is not None else float(best[3])
    return Sphere(best[:3], size, _form_um(residual(best)), len(points))


def fit_cylinder(points: ArrayLike, axis: ArrayLike | None = None) -> Cylinder:
    """The cylinder of points (n, 3) mm.

    ``axis`` is a start direction; without it the direction is used in which the surface normals of a smooth
    patch vary least, estimated from a quadric fit of the points.
    """
    points = _finite(points, 6)
    start = np.asarray(axis, np.float64) if axis is not None else _straight_direction(points)
    start = start / np.linalg.norm(start)
    # Two unit vectors across the start axis: start + p0 e0 + p1 e1 has no singularity near it.
    e0, e1 = np.linalg.svd(start[None])[2][1:]
    middle = points.mean(axis=0)
    flat = np.column_stack([(points - middle) @ e0, (points - middle) @ e1])
    centre, radius = _algebraic_ball(flat)

    def cylinder(p: NDArray[np.float64]) -> Cylinder:
        direction = start + p[0] * e0 + p[1] * e1
        origin = middle + p[2] * e0 + p[3] * e1
        return Cylinder(origin, direction / np.linalg.norm(direction), float(p[4]), 0.0, 0)

    best = _soft(lambda p: cylinder(p).distance(points), np.array([0.0, 0.0, *centre, radius]))
    fit = cylinder(best)
    return Cylinder(fit.centre, fit.axis, fit.radius_mm, _form_um(fit.distance(points)), len(points))


def step_height_mm(lower: Plane, points: ArrayLike) -> tuple[float, float]:
    """Mean height (mm) of points above the plane they are parallel to, and their form (um)."""
    distance = lower.distance(_finite(points, 3))
    kept = np.abs(distance - np.median(distance)) <= _TUKEY * max(_noise(distance), _RESOLUTION_MM)
    return float(abs(distance[kept].mean())), _form_um(distance)


def wedge_angle_deg(one: Plane, other: Plane, inside: ArrayLike | None = None) -> float:
    """Angle between two flanks, 0..180 deg.

    ``inside``, a point in the material below the edge, tells the angle from its supplement; without it the
    smaller of the two is meant.
    """
    cosine = float(one.normal @ other.normal)
    if inside is not None:
        point = np.atleast_2d(np.asarray(inside, np.float64))
        cosine *= -float(np.sign(one.distance(point)[0]) * np.sign(other.distance(point)[0]))
    else:
        cosine = abs(cosine)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


@dataclass(frozen=True, slots=True)
class SurfaceError:
    """Signed distances of points to the true surface."""

    mean_um: float
    std_um: float
    rms_um: float
    p95_um: float
    """95 % of the points are nearer than this."""
    count: int


def surface_error(points: ArrayLike, distance: Callable[[NDArray[np.float64]], ArrayLike]) -> SurfaceError:
    """Of points (n, 3) mm against ``distance``: points (n, 3) -> signed distances (n,) mm."""
    error_um = 1e3 * np.asarray(distance(_finite(points, 1)), np.float64)
    return SurfaceError(
        mean_um=float(error_um.mean()),
        std_um=float(error_um.std()),
        rms_um=float(np.sqrt(np.mean(error_um**2))),
        p95_um=float(np.percentile(np.abs(error_um), 95)),
        count=len(error_um),
    )


def _finite(points: ArrayLike, at_least: int) -> NDArray[np.float64]:
    points = np.asarray(points, np.float64).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < at_least:
        raise ValueError(f"{len(points)} valid points, {at_least} or more are needed")
    return points


def _noise(distance: NDArray[np.float64]) -> float:
    return _MAD_TO_SIGMA * float(np.median(np.abs(distance - np.median(distance))))


def _form_um(distance: NDArray[np.float64]) -> float:
    return 1e3 * float(distance.std())


def _soft(
    residual: Callable[[NDArray[np.float64]], NDArray[np.float64]], start: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Soft-L1 at the residual's own scale; then again without gross outliers, which it only dampens."""
    kept: NDArray[np.bool_] = np.ones(len(residual(start)), np.bool_)

    def kept_residual(p: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.where(kept, residual(p), 0.0)

    for _ in range(3):
        scale = max(_noise(residual(start)[kept]), _RESOLUTION_MM)
        fit = least_squares(kept_residual, start, loss="soft_l1", f_scale=scale, x_scale="jac", xtol=1e-12)
        start = fit.x
        kept = np.abs(residual(start)) < _TUKEY * max(_noise(residual(start)), _RESOLUTION_MM)
    return start


def _algebraic_ball(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Circle (n, 2) or sphere (n, 3) by the form that is linear in its unknowns (Coope, 1993)."""
    middle = points.mean(axis=0)
    relative = points - middle
    A = np.column_stack([2.0 * relative, np.ones(len(points))])
    solution = np.linalg.lstsq(A, (relative**2).sum(axis=1), rcond=None)[0]
    offset = solution[:-1]
    return offset + middle, float(np.sqrt(solution[-1] + offset @ offset))


def _straight_direction(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Direction of least curvature of z = quadric(x, y) in the patch's own principal axes."""
    middle = points.mean(axis=0)
    axes = np.linalg.svd(points - middle, full_matrices=False)[2]
    x, y, z = axes @ (points - middle).T
    A = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    _, _, _, xx, xy, yy = np.linalg.lstsq(A, z, rcond=None)[0]
    values, vectors = np.linalg.eigh([[2.0 * xx, xy], [xy, 2.0 * yy]])
    u, v = vectors[:, np.argmin(np.abs(values))]
    direction: NDArray[np.float64] = u * axes[0] + v * axes[1]
    return direction
