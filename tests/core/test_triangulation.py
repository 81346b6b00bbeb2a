"""The lookup against the exact solution."""

from __future__ import annotations

import numpy as np
import pytest
from planes import head_rig

from endo3d_core import triangulation

HEAD_RANGES = {"base6_wd20": (16.5, 23.5), "base35_wd20": (16.5, 23.5), "base6_wd10": (8.25, 11.75)}


def triangulate(
    lookup: triangulation.Lookup, v: int, offset_px: np.ndarray, variance: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One row of projector coordinates relative to mid-depth -> points (width, 6), xyz (width, 3), depth (width,)."""
    row, values = np.empty((7, lookup.width), np.float32), np.ones((6, lookup.width), np.float32)
    points, xyz = np.empty((1, lookup.width, 6), np.float32), np.empty((1, lookup.width, 3), np.float32)
    depth = np.empty((1, lookup.width), np.uint16)
    triangulation.interpolate_row(lookup.planes, v / lookup.rows_per_node, 0, row)
    triangulation.triangulate_row(
        row[1:5], np.float32(1.0), np.float32(lookup.z_min_mm - 0.1), np.float32(lookup.z_max_mm + 0.1),
        offset_px.astype(np.float32), np.full(lookup.width, variance, np.float32), values[2], values[5],
    )  # fmt: skip
    out = triangulation.output(points, xyz, depth, scale_mm=2e-4, offset_mm=lookup.z_min_mm - 1.0)
    assert triangulation.write_row(values, row[5:], 0, 0, out) == np.isfinite(offset_px).sum()
    return points[0], xyz[0], depth[0]


@pytest.mark.parametrize("name", HEAD_RANGES)
@pytest.mark.parametrize("bin_px", [1, 4])
def test_depth_is_within_a_tenth_of_a_micrometre_of_the_exact_one(name: str, bin_px: int) -> None:
    rig, (z_min, z_max) = head_rig(name), HEAD_RANGES[name]
    lookup = triangulation.build(rig, bin_px, z_min, z_max)
    rows, columns = 61 // bin_px, slice(None, None, 67 // bin_px)
    grid = triangulation.grid_pixels(rig, bin_px, "columns")[::rows, columns]
    truth = np.random.default_rng(7).uniform(z_min, z_max, grid.shape[:2])
    exact = rig.camera.ray(grid) * truth[..., None]
    coordinate = triangulation.coded(rig.projector_pixel(exact), "columns")
    row = np.empty((7, lookup.width), np.float32)
    for v in range(grid.shape[0]):
        triangulation.interpolate_row(lookup.planes, v * rows / lookup.rows_per_node, 0, row)
        offset = np.full(lookup.width, np.nan)
        offset[columns] = coordinate[v] - row[0][columns]
        points, xyz, depth = triangulate(lookup, v * rows, offset, 0.0)
        np.testing.assert_allclose(points[columns, :3], exact[v], atol=1e-4)
        np.testing.assert_array_equal(xyz, points[:, :3])
        z = np.where(depth > 0, z_min - 1.0 + 2e-4 * depth, np.nan)
        np.testing.assert_allclose(z, points[:, 2], atol=1.01e-4)


def test_exact_depth_inverts_projection() -> None:
    rig = head_rig()
    pixels = rig.camera.pixel_grid()[::200, ::200]
    truth = np.linspace(17.0, 23.0, pixels.shape[0] * pixels.shape[1]).reshape(pixels.shape[:2])
    coordinate = triangulation.coded(rig.projector_pixel(rig.camera.ray(pixels) * truth[..., None]), "columns")
    np.testing.assert_allclose(triangulation.exact_depth(rig, pixels, coordinate, 20.0), truth, atol=1e-9)


def test_sigma_is_the_slope_times_the_phase_noise() -> None:
    """Two coordinates a little apart: their depths differ by what sigma says."""
    lookup = triangulation.build(head_rig(), 4, 16.5, 23.5)
    near, far = (triangulate(lookup, 80, np.full(lookup.width, px), 0.12**2)[0] for px in (3.0, 3.12))
    np.testing.assert_allclose(np.abs(far[:, 2] - near[:, 2]), near[:, 5], rtol=0.02)


def test_an_empty_depth_range_is_refused() -> None:
    with pytest.raises(ValueError, match="depth range"):
        triangulation.build(head_rig(), 4, 20.0, 20.0)
