"""Triangle meshes: which triangle a ray meets is Embree's answer, where on it is computed here."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d_core.compiled import exact

Array = NDArray[np.float64]


class Mesh:
    """A mesh in mm, ready for rays."""

    def __init__(self, path: Path, scale: float) -> None:
        """Read an STL or PLY file. Raises ``ValueError`` that says what to do."""
        import trimesh

        try:
            from trimesh.ray.ray_pyembree import RayMeshIntersector
        except ImportError as error:
            raise ValueError("mesh scenes need Embree: pip install 'endo3d[mesh]'") from error
        try:
            self.mesh: Any = trimesh.load_mesh(path)
        except (OSError, ValueError, NotImplementedError) as error:
            raise ValueError(f"mesh file {str(path)!r} can't be read: {error}") from error
        if len(self.mesh.faces) == 0:
            raise ValueError(f"mesh file {str(path)!r} holds no triangles")
        self.mesh.vertices = np.asarray(self.mesh.vertices) * scale
        self._rays: Any = RayMeshIntersector(self.mesh)
        self.corners = np.ascontiguousarray(self.mesh.triangles[:, 0], np.float64)
        self.normals = np.ascontiguousarray(self.mesh.face_normals, np.float64)

    def first(self, origin: Array, directions: Array) -> tuple[Array, NDArray[np.int64]]:
        """(n, 3) directions from a point -> how many of them to the first hit (inf: none), and the triangle."""
        triangle = self._rays.intersects_first(np.broadcast_to(origin, directions.shape), directions)
        advance = np.full(len(directions), np.inf)
        _advance(origin, directions, np.asarray(triangle, np.int64), self.corners, self.normals, advance)
        return advance, np.asarray(triangle, np.int64)

    def distances(self, points: Array) -> Array:
        """(n,) signed distances of points (n, 3), positive outside; a thousand points per second."""
        from trimesh.proximity import closest_point

        near: Any = closest_point
        nearest, gap, triangle = near(self.mesh, points)
        side = np.sign(np.einsum("ij,ij->i", points - nearest, self.normals[triangle]))
        return np.asarray(np.where(side < 0.0, -gap, gap))


@exact
def _advance(
    origin: Array,
    directions: Array,
    triangle: NDArray[np.int64],
    corners: Array,
    normals: Array,
    out: Array,
) -> None:
    for i in range(out.size):
        k = triangle[i]
        if k >= 0:
            up, way = 0.0, 0.0
            for axis in range(3):
                up += normals[k, axis] * (corners[k, axis] - origin[axis])
                way += normals[k, axis] * directions[i, axis]
            out[i] = up / way if way != 0.0 else np.inf


@lru_cache(maxsize=4)
def load(path: Path, scale: float) -> Mesh:
    """A mesh by its file."""
    return Mesh(path, scale)
