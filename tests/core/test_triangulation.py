"""The lookup against the exact solution."""

from __future__ import annotations

import numpy as np
import pytest
from planes import head_rig

from endo3d_core import triangulation

HEAD_RANGES = {"base6_wd20": (16.5, 23.5), "base35_wd20": (16.5, 23.5), "base6_wd10": (8.25, 11.75)}


@pytest.mark.parametrize("name", HEAD_RANGES)
@pytest.mark.parametrize("bin_px", [1, 4])
def test_depth_is_within_a_tenth_of_a_micrometre_of_the_exact_one(name: str, bin_px: int) -> None:
    rig, (z_min, z_max) = head_rig(name), HEAD_RANGES[name]
    lookup = triangulation.build(rig, bin_px, z_min, z_max)
    grid = triangulation.grid_pixels(rig, bin_px, "columns")[:: 61 // bin_px, :: 67 // bin_px]
    rng = np.random.default_rng(7)
    truth = rng.uniform(z_min, z_max, grid.shape[:2])
    points = rig.camera.ray(grid) * truth[..., None]
    coordinate = triangulation.coded(rig.projector_pixel(points), "columns")
    row = np.empty((triangulation.ROW_PLANES, lookup.width), np.float32)
    out = np.empty((lookup.width, 6), np.float32)
    ones = np.ones(lookup.width, np.float32)
    for v in range(grid.shape[0]):
        triangulation.interpolate_row(lookup.planes, v * (61 // bin_px) / lookup.rows_per_node, row)
        columns = slice(None, None, 67 // bin_px)
        offset = np.full(lookup.width, np.nan, np.float32)
        offset[columns] = coordinate[v] - row[0][columns]
        one, low, high = np.float32(1.0), np.float32(z_min - 0.1), np.float32(z_max + 0.1)
        triangulation.write_row(row, one, low, high, offset, ones, ones, ones, out)
        np.testing.assert_allclose(out[columns, :3], points[v], atol=1e-4)


def test_exact_depth_inverts_projection() -> None:
    rig = head_rig()
    pixels = rig.camera.pixel_grid()[::200, ::200]
    truth = np.linspace(17.0, 23.0, pixels.shape[0] * pixels.shape[1]).reshape(pixels.shape[:2])
    coordinate = triangulation.coded(rig.projector_pixel(rig.camera.ray(pixels) * truth[..., None]), "columns")
    np.testing.assert_allclose(triangulation.exact_depth(rig, pixels, coordinate, 20.0), truth, atol=1e-9)


def test_sigma_is_the_slope_times_the_phase_noise() -> None:
    """Two phases a little apart: their depths differ by what sigma says."""
    lookup = triangulation.build(head_rig(), 4, 16.5, 23.5)
    row = np.empty((triangulation.ROW_PLANES, lookup.width), np.float32)
    depths = []
    for phase in (0.5, 0.52):
        triangulation.interpolate_row(lookup.planes, 20.0, row)
        out = np.empty((lookup.width, 6), np.float32)
        flat = np.full(lookup.width, phase, np.float32)
        ones, spread = np.ones(lookup.width, np.float32), np.full(lookup.width, 0.02**2, np.float32)
        scale, low, high = np.float32(6.1), np.float32(16.5), np.float32(23.5)
        triangulation.write_row(row, scale, low, high, flat, ones, ones, spread, out)
        depths.append(out)
    np.testing.assert_allclose(np.abs(depths[1][:, 2] - depths[0][:, 2]), depths[0][:, 5], rtol=0.02)


def test_an_empty_depth_range_is_refused() -> None:
    with pytest.raises(ValueError, match="depth range"):
        triangulation.build(head_rig(), 4, 20.0, 20.0)
