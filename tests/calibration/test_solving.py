"""Synthetic features to a calibration: outliers, verdicts, sigma, and what the file says of it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from endo3d.services.evaluation.virtual_run import head_yaml
from endo3d_core.calibrating.bundle import Solution
from endo3d_core.calibrating.judging import depth_sigma_um, reasons
from endo3d_core.calibrating.outliers import solve_without_outliers
from endo3d_core.calibrating.quality import Quality
from endo3d_core.calibrating.seeing import covered, drawn, share_covered
from endo3d_core.calibrating.sighting import Sighting
from endo3d_core.calibration import Rig
from endo3d_core.triangulation import exact_depth

RIG = Rig.from_yaml(head_yaml("base6_wd20"))
CAMERA, PROJECTOR = (1920, 1200), (960, 960)
NOISE_PX = 0.06


def sightings(count: int, seed: int = 0) -> list[Sighting]:
    """A board of 9 x 7 at 1 mm about the working distance; the projector's error follows the camera's."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(9) - 4.0, np.arange(7) - 3.0)
    board = np.stack((x.ravel(), y.ravel(), np.zeros(x.size)), axis=1)
    seen = []
    for index in range(count):
        tilt = 0.4 * np.array((np.cos(2.4 * index), np.sin(2.4 * index), 0.2))
        at = (0.5 * np.cos(index), 0.5 * np.sin(index), 20 + 2 * np.sin(1.7 * index))
        points = board @ cv2.Rodrigues(tilt)[0].T + at
        off = rng.normal(0, NOISE_PX, (len(board), 2))
        own = rng.normal(0, NOISE_PX / 4, (len(board), 2))
        camera, projector = RIG.camera.project(points) + off, RIG.projector_pixel(points) + 0.78 * off + own
        seen.append(Sighting(f"board_{index:02d}", board, camera, projector))
    return seen


@pytest.fixture(scope="module")
def solution() -> Solution:
    return solve_without_outliers(sightings(10), CAMERA, PROJECTOR).solution


def test_a_pose_that_moved_is_left_out_with_the_reason() -> None:
    poses = sightings(8)
    moved = poses[3]
    shaken = moved.projector_px + (1.5, -1.0) * np.sin(moved.board_mm[:, :1])
    poses[3] = Sighting(moved.name, moved.board_mm, moved.camera_px, shaken)
    found = solve_without_outliers(poses, CAMERA, PROJECTOR)
    assert list(found.rejected) == ["board_03"]
    assert "times the usual one" in found.rejected["board_03"]
    assert len(found.kept) == 7


def test_depth_errors_are_as_stated(solution: Solution) -> None:
    pixels = np.array([[u, v] for u in (600.0, 960.0, 1300.0) for v in (350.0, 600.0, 850.0)])
    sigma = depth_sigma_um(solution, pixels, (18.5, 21.5))
    rays = RIG.camera.ray(pixels)
    errors = [
        1e3 * (exact_depth(solution.rig, pixels, RIG.projector_pixel(rays * z)[:, 0], z) - z)
        for z in (18.5, 20.0, 21.5)
    ]
    assert np.abs(errors).max() < 4 * sigma
    assert np.abs(errors).max() > sigma / 20


def test_bad_calibrations_are_refused_with_the_reason() -> None:
    good = Quality("good", poses=15, reprojection_px=(0.08, 0.08), depth_sigma_um=2.0, coverage=0.8)
    assert reasons(good, 20.0) == []
    for change, why in (
        ({"poses": 4}, "too few"),
        ({"reprojection_px": (0.1, 0.9)}, "pitch"),
        ({"coverage": 0.2}, "rims"),
        ({"depth_sigma_um": 30.0}, "tilt"),
        ({"depth_sigma_um": float("nan")}, "tilt"),
    ):
        assert any(why in reason for reason in reasons(replace(good, **change), 20.0)), change


def test_the_state_travels_in_the_file_and_reads_as_a_line(solution: Solution) -> None:
    bad = Quality("bad", "moved", 7, ("board_03",), (0.7, 0.6), 12.0, 0.5, (9.0, 1.0), 1.02, sigma=solution.sigma)
    text = solution.rig.to_yaml() + bad.to_yaml()
    back = Quality.from_yaml(text)
    assert back.state == "bad"
    assert back.rejected == ("board_03",)
    assert back.sigma.keys() == solution.sigma.keys()
    assert "BAD (moved)" in back.line
    assert Rig.from_yaml(text).to_yaml() == solution.rig.to_yaml()
    assert "nobody has calibrated" in Quality.from_yaml(head_yaml("base6_wd20")).line
    with pytest.raises(ValueError, match="not what calibrate writes"):
        Quality.from_yaml("quality: {state: good, colour: blue}")


def test_coverage_counts_cells_of_the_lit_field() -> None:
    lit = np.stack([a.ravel() for a in np.meshgrid(np.arange(100.0), np.arange(100.0))], axis=-1)
    board = np.zeros((8, 3))
    corner = Sighting("a", board, np.full((8, 2), 4.0) + np.arange(8)[:, None] * 0.1, np.zeros((8, 2)))
    cells = covered([corner], lit)
    assert share_covered(cells) == pytest.approx(1 / cells.size)
    assert drawn(cells).startswith(" 8 .")
