"""Depth maps and trajectories in files, read back by OpenCV, NumPy and by hand."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scans import START_NS, messages, points_of, pose_of

from endo3d.schemas.messages import DepthMap, Pose, Tracking
from endo3d.services.exchange.depth import write_depth_maps
from endo3d.services.exchange.track import write_track
from endo3d.services.runtime.errors import UserError


def maps() -> list[DepthMap]:
    return [message for message in messages(3) if isinstance(message, DepthMap)]


@pytest.mark.parametrize("kind", ["png", "tiff"])
def test_16_bit_images_give_depth_in_mm(tmp_path: Path, kind: str) -> None:
    assert write_depth_maps(maps(), tmp_path / "depth", kind) == 3
    index = json.loads((tmp_path / "depth" / "depth.json").read_text())["maps"]
    for k, entry in enumerate(index):
        image = cv2.imread(str(tmp_path / "depth" / entry["file"]), cv2.IMREAD_UNCHANGED)
        assert image is not None
        assert image.dtype == np.uint16
        z_mm = entry["offset_mm"] + entry["scale_mm"] * image
        expected = points_of(k)["z"]
        np.testing.assert_array_equal(image == 0, np.isnan(expected))
        np.testing.assert_allclose(z_mm[image > 0], expected[image > 0], atol=0.51 * entry["scale_mm"])
        assert entry["stamp_ns"] == START_NS + 40_000_000 * k


def test_npy_is_in_mm_and_nan_where_invalid(tmp_path: Path) -> None:
    write_depth_maps(maps(), tmp_path, "npy")
    z_mm = np.load(tmp_path / "00000001.npy")
    np.testing.assert_allclose(z_mm, points_of(1)["z"], atol=1.1e-4)


def test_an_unknown_depth_format_names_the_known(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="png, tiff, npy"):
        write_depth_maps(maps(), tmp_path, "exr")


def poses() -> list[Pose]:
    return [message for message in messages(4) if isinstance(message, Pose)]


def test_tum_is_in_seconds_and_metres(tmp_path: Path) -> None:
    assert write_track(poses(), tmp_path / "way.tum") == 4
    lines = [line.split() for line in (tmp_path / "way.tum").read_text().splitlines() if line[0] != "#"]
    assert lines[0][0] == "1700000000.123456789"
    for k, line in enumerate(lines):
        np.testing.assert_allclose([float(v) for v in line[1:4]], 1e-3 * pose_of(k)[:3, 3], atol=1e-9)
        half = np.deg2rad(0.25 * k)
        np.testing.assert_allclose([float(v) for v in line[4:]], [0, np.sin(half), 0, np.cos(half)], atol=1e-8)


def test_csv_is_in_mm_with_uncertainty(tmp_path: Path) -> None:
    write_track(poses(), tmp_path / "way.csv")
    header, *lines = (tmp_path / "way.csv").read_text().splitlines()
    rows = [dict(zip(header.split(","), line.split(","), strict=True)) for line in lines]
    assert [row["state"] for row in rows] == [Tracking.TRACKING] * 4
    assert int(rows[2]["stamp_ns"]) == START_NS + 80_000_000
    assert float(rows[3]["x_mm"]) == pytest.approx(0.75)
    sigmas = [float(rows[0][f"sigma_{axis}_um"]) for axis in "xyz"]
    np.testing.assert_allclose(sigmas, [2, 3, 5], rtol=1e-6)


def test_an_unknown_trajectory_format_names_the_known(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"\.tum, \.txt, \.csv"):
        write_track(poses(), tmp_path / "way.json")
