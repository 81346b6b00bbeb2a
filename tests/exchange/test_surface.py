"""Surfaces through points of a known shape, judged by trimesh."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from endo3d.services.exchange.surface import write_surface
from endo3d.services.runtime.errors import UserError
from endo3d_core.merging import MAP_POINT

RADIUS_MM = 5.0


def dome(count: int = 2500) -> NDArray[np.void]:
    """(n,) MAP_POINT on the upper part of a sphere of 5 mm, normals outwards."""
    k = np.arange(count)
    z = 1 - 0.8 * k / count  # Fibonacci spiral over the cap z > 0.2 R
    angle = k * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z * z)
    unit = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
    rows = np.zeros(count, MAP_POINT)
    for j, axis in enumerate("xyz"):
        rows[axis], rows[f"n{axis}"] = RADIUS_MM * unit[:, j], unit[:, j]
    return rows


@pytest.mark.parametrize(("method", "suffix"), [("poisson", "stl"), ("ball-pivoting", "obj")])
def test_the_surface_lies_on_the_sphere(tmp_path: Path, method: str, suffix: str) -> None:
    pytest.importorskip("pymeshlab")
    path = tmp_path / f"dome.{suffix}"
    faces = write_surface(dome(), path, method=method)
    mesh = trimesh.load(path, force="mesh")
    assert len(mesh.faces) == faces
    radii = np.linalg.norm(mesh.vertices, axis=1)
    inside = mesh.vertices[:, 2] > 0.3 * RADIUS_MM
    np.testing.assert_allclose(radii[inside], RADIUS_MM, atol=0.02)
    assert mesh.vertices[:, 2].min() > 0.05 * RADIUS_MM  # nothing is invented far below the last points
    within = mesh.area_faces[mesh.triangles_center[:, 2] > 0.3 * RADIUS_MM].sum()
    assert within == pytest.approx(2 * np.pi * RADIUS_MM * 0.7 * RADIUS_MM, rel=0.02)  # and there is no hole
    outwards = np.einsum("ij,ij->i", mesh.face_normals, mesh.triangles_center)
    assert np.mean(outwards > 0) > 0.99


def test_without_normals_they_are_estimated_towards_the_viewer(tmp_path: Path) -> None:
    pytest.importorskip("pymeshlab")
    bare = dome()[["x", "y", "z"]]
    write_surface(bare, tmp_path / "dome.stl", viewer=np.array([0, 0, 40.0]))
    mesh = trimesh.load(tmp_path / "dome.stl", force="mesh")
    outwards = np.einsum("ij,ij->i", mesh.face_normals, mesh.triangles_center)
    assert np.mean(outwards > 0) > 0.99


def test_without_its_package_it_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pymeshlab", None)
    with pytest.raises(UserError, match=r"pip install 'endo3d\[surface\]'"):
        write_surface(dome(), tmp_path / "dome.stl")


@pytest.mark.parametrize(("method", "name"), [("marching", "a.stl"), ("poisson", "a.step")])
def test_what_it_can_not_do_names_what_it_can(tmp_path: Path, method: str, name: str) -> None:
    pytest.importorskip("pymeshlab")
    with pytest.raises(UserError, match=r"poisson, ball-pivoting.*\.stl, \.obj, \.ply"):
        write_surface(dome(), tmp_path / name, method=method)
