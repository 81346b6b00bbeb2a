"""A closed-up surface from a merged map: triangles for CAD and printing, by MeshLab's algorithms.

Screened Poisson (Kazhdan and Hoppe 2013) smooths and fills small holes; ball pivoting (Bernardini et al.
1999) keeps every measured point. Both are pymeshlab's, which is GPL: an extra that the user installs.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from endo3d.services.exchange.finite import finite, xyz_mm
from endo3d.services.runtime.errors import UserError

METHODS = ("poisson", "ball-pivoting")
SUFFIXES = (".stl", ".obj", ".ply")
FAR_SPACINGS = 3.0
"""A vertex farther than this from every measured point is invention, and is cut off."""


def write_surface(
    points: NDArray[Any],
    path: str | Path,
    *,
    method: str = "poisson",
    viewer: NDArray[np.floating] | None = None,
) -> int:
    """Writes triangles through structured points (mm), STL, OBJ or PLY by the suffix; returns how many.

    Normals are the points' nx ny nz, else estimated and turned to the ``viewer`` (3,). Raises ``UserError``.
    """
    try:
        import pymeshlab
    except ModuleNotFoundError as error:
        raise UserError("a surface needs an optional package: pip install 'endo3d[surface]'") from error
    target = Path(path)
    if method not in METHODS or target.suffix.lower() not in SUFFIXES:
        raise UserError(f"a surface is one of {', '.join(METHODS)}, in a file {', '.join(SUFFIXES)}")
    rows = finite(points)
    if len(rows) < 100:
        raise UserError(f"{len(rows)} points are too few for a surface")
    positions = xyz_mm(rows)
    spacing_mm = _spacing_mm(positions)
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(vertex_matrix=positions, v_normals_matrix=_normals(rows, positions)))
    if not _has_normals(rows):
        towards = np.zeros(3) if viewer is None else np.asarray(viewer, float)
        meshes.compute_normal_for_point_clouds(k=12, flipflag=True, viewpos=towards)
    if method == "poisson":
        extent = float(np.ptp(positions, axis=0).max())
        depth = min(12, max(6, math.ceil(math.log2(1.1 * extent / spacing_mm))))
        meshes.generate_surface_reconstruction_screened_poisson(depth=depth, preclean=True, threads=1)
    else:
        meshes.generate_surface_reconstruction_ball_pivoting(ballradius=pymeshlab.PureValue(2.0 * spacing_mm))
    mesh = meshes.current_mesh()
    vertices, faces = _near(mesh.vertex_matrix(), mesh.face_matrix(), positions, FAR_SPACINGS * spacing_mm)
    if not len(faces):
        raise UserError("no surface found in these points: try the other method, or a coarser merging distance")
    trimmed = pymeshlab.MeshSet(verbose=False)
    trimmed.add_mesh(pymeshlab.Mesh(vertex_matrix=vertices, face_matrix=faces))
    trimmed.save_current_mesh(str(target))
    return len(faces)


def _has_normals(rows: NDArray[Any]) -> bool:
    return "nx" in (rows.dtype.names or ())


def _normals(rows: NDArray[Any], positions: NDArray[np.float64]) -> NDArray[np.float64]:
    if not _has_normals(rows):
        return np.zeros_like(positions)
    return np.stack([rows[axis] for axis in ("nx", "ny", "nz")], axis=-1).astype(np.float64)


def _spacing_mm(positions: NDArray[np.float64]) -> float:
    """Median distance to the nearest neighbour."""
    sample = positions[:: max(1, len(positions) // 20_000)]
    distances = np.asarray(cKDTree(positions).query(sample, k=2)[0])
    return float(np.median(distances[:, 1]))


def _near(
    vertices: NDArray[np.float64], faces: NDArray[Any], positions: NDArray[np.float64], far_mm: float
) -> tuple[NDArray[np.float64], NDArray[Any]]:
    """The faces all of whose vertices are near a measured point, and the vertices they use."""
    near = np.asarray(cKDTree(positions).query(vertices, distance_upper_bound=far_mm)[0]) < far_mm
    kept = faces[near[faces].all(axis=1)]
    used = np.unique(kept)
    number = np.zeros(len(vertices), np.int64)
    number[used] = np.arange(len(used))
    return vertices[used], number[kept]
