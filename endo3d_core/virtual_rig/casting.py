"""Rays meet shapes: fast for images (prepared once per pose, chunk by chunk), exact for the truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from endo3d_core.virtual_rig import freeform, profile, sphere
from endo3d_core.virtual_rig.mesh import Mesh
from endo3d_core.virtual_rig.profile import FAR_MM, Profile, View
from endo3d_core.virtual_rig.scene import Freeform, Shape, Sphere

BIAS_MM = np.float32(0.004)
"""A surface point must lie this far behind another one to be in its shadow."""

SLOPES = 8192
"""Directions in which an extruded scene is tabulated: 2 um apart on the object."""


@dataclass(slots=True, eq=False)
class Chunk:
    """Some rays of the camera, z = 1, and what they meet; all (n,) float32 but ``body``."""

    rx: NDArray[np.float32]
    ry: NDArray[np.float32]
    z: NDArray[np.float32]
    nx: NDArray[np.float32]
    ny: NDArray[np.float32]
    nz: NDArray[np.float32]
    body: NDArray[np.uint8]
    lit: NDArray[np.float32]


class Sight(Protocol):
    """One body from one pose."""

    def cast(self, chunk: Chunk, index: np.uint8) -> None:
        """Depth, normal and body where this one is nearer."""

    def shadow(self, chunk: Chunk) -> None:
        """Clear ``lit`` where this one stands in the projector's light."""


@dataclass(frozen=True, eq=False)
class Field:
    """The outlines of what camera and projector can see, as rays with z = 1: (n, 3)."""

    camera: NDArray[np.float64]
    projector: NDArray[np.float64]
    """In the camera's axes."""
    projector_centre_mm: NDArray[np.float64]


def sight(shape: Shape, T_body_camera: NDArray[np.float64], field: Field) -> Sight:
    """Prepare a shape for one pose."""
    match shape:
        case Profile():
            return ProfileSight(shape, T_body_camera, field)
        case Sphere():
            return SphereSight(shape, T_body_camera, field)
        case Freeform():
            return FreeformSight(shape, T_body_camera)
        case Mesh():
            return MeshSight(shape, T_body_camera, field)


def cast_exact(
    shape: Shape,
    T_body_view: NDArray[np.float64],
    rx: NDArray[np.float64],
    ry: NDArray[np.float64],
    z: NDArray[np.float64],
) -> None:
    """Lower ``z`` (n,) to the depths at which the rays (rx, ry, 1) of a view meet the shape."""
    T = np.ascontiguousarray(T_body_view)
    match shape:
        case Profile():
            profile.cast_exact(shape.primitives, T, rx, ry, z)
        case Sphere():
            sphere.cast_exact(shape.radius_mm, T, rx, ry, z)
        case Freeform():
            freeform.cast_exact(shape.parameters, T, rx, ry, z)
        case Mesh():
            directions = np.stack((rx, ry, np.ones_like(rx)), axis=-1) @ T[:3, :3].T
            np.minimum(z, shape.first(T[:3, 3], directions)[0], out=z)


def distances(shape: Shape, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 3) points of the body's axes -> (n,) signed distances to its surface, positive outside, mm."""
    match shape:
        case Profile():
            out = np.empty(len(points))
            x, z = (np.ascontiguousarray(points[:, k]) for k in (0, 2))
            profile.distances(shape.primitives, x, z, out)
            return out
        case Sphere():
            return np.asarray(np.linalg.norm(points, axis=1) - shape.radius_mm)
        case Freeform():
            out = np.empty(len(points))
            freeform.distances(shape.parameters, points, out)
            return out
        case Mesh():
            return shape.distances(points)


class ProfileSight:
    def __init__(self, shape: Profile, T: NDArray[np.float64], field: Field) -> None:
        self.T = T.astype(np.float32)
        lamp = T[:3, :3] @ field.projector_centre_mm + T[:3, 3]
        self.lamp_x, self.lamp_z = np.float32(lamp[0]), np.float32(lamp[2])
        self.camera = self._view(shape, T[:3, 3], field.camera @ T[:3, :3].T)
        self.projector = self._view(shape, lamp, field.projector @ T[:3, :3].T)

    @staticmethod
    def _view(shape: Profile, origin: NDArray[np.float64], rays: NDArray[np.float64]) -> View:
        slopes = rays[:, 0] / rays[:, 2]
        low, high = float(slopes.min()), float(slopes.max())
        margin = 0.02 * (high - low)
        return profile.seen_from(shape, origin[0], origin[2], (low - margin, high + margin), SLOPES)

    def cast(self, chunk: Chunk, index: np.uint8) -> None:
        view, c = self.camera, chunk
        first, per_unit = np.float32(view.first_slope), np.float32(view.slopes_per_unit)
        profile.cast(
            self.T, first, per_unit, view.advance, view.nx, view.nz,
            c.rx, c.ry, c.z, c.nx, c.ny, c.nz, c.body, index,
        )  # fmt: skip

    def shadow(self, chunk: Chunk) -> None:
        view, c = self.projector, chunk
        first, per_unit = np.float32(view.first_slope), np.float32(view.slopes_per_unit)
        profile.shadow(self.T, self.lamp_x, self.lamp_z, first, per_unit, view.advance, BIAS_MM, c.rx, c.ry, c.z, c.lit)


class SphereSight:
    def __init__(self, shape: Sphere, T: NDArray[np.float64], field: Field) -> None:
        self.centre = (-T[:3, :3].T @ T[:3, 3]).astype(np.float32)
        self.radius = np.float32(shape.radius_mm)
        self.lamp = field.projector_centre_mm.astype(np.float32)

    def cast(self, chunk: Chunk, index: np.uint8) -> None:
        c = chunk
        sphere.cast(self.centre, self.radius, c.rx, c.ry, c.z, c.nx, c.ny, c.nz, c.body, index)

    def shadow(self, chunk: Chunk) -> None:
        c = chunk
        sphere.shadow(self.centre, self.radius, self.lamp, BIAS_MM, c.rx, c.ry, c.z, c.lit)


class FreeformSight:
    def __init__(self, shape: Freeform, T: NDArray[np.float64]) -> None:
        self.parameters, self.T = shape.parameters.astype(np.float32), T.astype(np.float32)

    def cast(self, chunk: Chunk, index: np.uint8) -> None:
        c = chunk
        freeform.cast(self.parameters, self.T, c.rx, c.ry, c.z, c.nx, c.ny, c.nz, c.body, index)

    def shadow(self, chunk: Chunk) -> None:
        """None: the surface is convex."""


class MeshSight:
    def __init__(self, shape: Mesh, T: NDArray[np.float64], field: Field) -> None:
        self.shape, self.T = shape, T
        self.lamp = T[:3, :3] @ field.projector_centre_mm + T[:3, 3]

    def cast(self, chunk: Chunk, index: np.uint8) -> None:
        c = chunk
        rays = np.stack((c.rx, c.ry, np.ones_like(c.rx)), axis=-1).astype(np.float64)
        depth, triangle = self.shape.first(self.T[:3, 3], rays @ self.T[:3, :3].T)
        nearer = depth < c.z
        normals = self.shape.normals[triangle[nearer]] @ self.T[:3, :3]
        # Meshes may be wound either way: what is seen faces the camera.
        normals *= -np.sign(np.einsum("ij,ij->i", normals, rays[nearer]))[:, None]
        c.z[nearer], c.body[nearer] = depth[nearer], index
        c.nx[nearer], c.ny[nearer], c.nz[nearer] = normals.T

    def shadow(self, chunk: Chunk) -> None:
        c = chunk
        seen = np.flatnonzero(c.z < FAR_MM / 2)
        points = c.z[seen, None] * np.stack((c.rx[seen], c.ry[seen], np.ones(len(seen))), axis=-1)
        away = points @ self.T[:3, :3].T + self.T[:3, 3] - self.lamp
        advance, _ = self.shape.first(self.lamp, away)
        c.lit[seen[(1.0 - advance) * np.linalg.norm(away, axis=1) > BIAS_MM]] = 0.0
