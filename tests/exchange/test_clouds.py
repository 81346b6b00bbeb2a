"""Clouds written by us, read by others' readers."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from plyfile import PlyData
from scans import map_of, points_of

from endo3d.services.exchange.clouds import write_cloud
from endo3d.services.exchange.finite import finite
from endo3d.services.runtime.errors import UserError


def test_ply_keeps_every_field_and_value(tmp_path: Path) -> None:
    rows = map_of(points_of(0))
    assert write_cloud(rows, tmp_path / "map.ply") == len(rows)
    vertex = PlyData.read(str(tmp_path / "map.ply"))["vertex"]
    assert [prop.name for prop in vertex.properties] == list(rows.dtype.names)
    for name in rows.dtype.names:
        assert vertex[name].dtype.kind == rows[name].dtype.kind
        np.testing.assert_array_equal(vertex[name], rows[name])


def test_ply_of_an_organised_cloud_has_its_valid_points(tmp_path: Path) -> None:
    points = points_of(0)
    assert write_cloud(points, tmp_path / "cloud.ply") == points.size - 12
    read = trimesh.load(tmp_path / "cloud.ply")
    valid = points[np.isfinite(points["z"])]
    np.testing.assert_array_equal(read.vertices, np.stack([valid[a] for a in "xyz"], axis=-1))


def test_pcd_reads_back_as_the_format_says(tmp_path: Path) -> None:
    rows = map_of(points_of(1))
    write_cloud(rows, tmp_path / "map.pcd")
    head, _, body = (tmp_path / "map.pcd").read_bytes().partition(b"DATA binary\n")
    header = dict(line.split(" ", 1) for line in head.decode().splitlines() if not line.startswith("#"))
    kinds = {"F": "f", "I": "i", "U": "u"}
    fields = zip(header["FIELDS"].split(), header["TYPE"].split(), header["SIZE"].split(), strict=True)
    read = np.frombuffer(body, [(name, f"<{kinds[kind]}{size}") for name, kind, size in fields])
    assert int(header["POINTS"]) == int(header["WIDTH"]) * int(header["HEIGHT"]) == len(read)
    for name in rows.dtype.names:
        np.testing.assert_array_equal(read[name], rows[name])


def test_xyz_is_good_to_a_tenth_of_a_micrometre(tmp_path: Path) -> None:
    points = points_of(2)
    write_cloud(points, tmp_path / "cloud.xyz")
    read = np.loadtxt(tmp_path / "cloud.xyz")
    valid = finite(points)
    np.testing.assert_allclose(read[:, :3], np.stack([valid[a] for a in "xyz"], axis=-1), atol=5.1e-5)
    np.testing.assert_allclose(read[:, 3], valid["intensity"], atol=5.1e-3)


def test_e57_is_in_metres(tmp_path: Path) -> None:
    pye57 = pytest.importorskip("pye57")
    points = points_of(3)
    write_cloud(points, tmp_path / "cloud.e57")
    file = pye57.E57(str(tmp_path / "cloud.e57"))
    read = file.read_scan_raw(0)
    valid = finite(points)
    for axis in "xyz":
        np.testing.assert_allclose(read[f"cartesian{axis.upper()}"], 1e-3 * valid[axis], rtol=3e-7)
    np.testing.assert_allclose(read["intensity"], valid["intensity"])
    file.close()


def test_e57_without_its_package_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pye57", None)
    with pytest.raises(UserError, match=r"pip install 'endo3d\[e57\]'"):
        write_cloud(points_of(0), tmp_path / "cloud.e57")


def test_an_unknown_format_names_the_known(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"\.ply, \.pcd, \.xyz, \.e57"):
        write_cloud(points_of(0), tmp_path / "cloud.las")


@pytest.mark.parametrize("suffix", ["ply", "pcd", "xyz"])
def test_an_empty_map_is_an_empty_file_of_its_format(tmp_path: Path, suffix: str) -> None:
    assert write_cloud(map_of(points_of(0))[:0], tmp_path / f"map.{suffix}") == 0
    assert (tmp_path / f"map.{suffix}").exists()
