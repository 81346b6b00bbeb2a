"""Rows of values into points, on any width: whole vectors and what is left over."""

from __future__ import annotations

import numpy as np
import pytest

from endo3d_core.packing import pack_points, pack_xyz


@pytest.mark.parametrize("width", [1, 15, 16, 17, 480, 481])
def test_packing_is_a_transposition(width: int) -> None:
    rows = np.random.default_rng(width).random((6, width), np.float32)
    points, xyz = np.full((width, 6), np.nan, np.float32), np.full((width, 3), np.nan, np.float32)
    pack_points(rows, points)
    pack_xyz(rows[:3], xyz)
    np.testing.assert_array_equal(points, rows.T)
    np.testing.assert_array_equal(xyz, rows[:3].T)
