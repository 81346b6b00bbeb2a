"""Bins are sums or means."""

from __future__ import annotations

import numpy as np
import pytest

from endo3d_core.binning import BINS, bin_image, grid_of


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("columns", BINS)
@pytest.mark.parametrize("rows", BINS)
def test_a_bin_is_the_mean_of_its_pixels(dtype: type[np.unsignedinteger], columns: int, rows: int) -> None:
    image = np.random.default_rng(3).integers(0, np.iinfo(dtype).max, (26, 43), dtype, endpoint=True)
    height, width = 26 // rows, 43 // columns
    kind, unit = grid_of(dtype, columns, rows)
    out = np.empty((height, width), kind)
    bin_image(image, columns, rows, out)
    means = image[: height * rows, : width * columns].reshape(height, rows, width, columns).mean((1, 3))
    np.testing.assert_allclose(unit * out, means, rtol=1e-6)


@pytest.mark.parametrize(("dtype", "full"), [(np.uint8, 255), (np.uint16, 65535)])
def test_the_brightest_bin_does_not_overflow(dtype: type[np.unsignedinteger], full: int) -> None:
    kind, unit = grid_of(dtype, 4, 4)
    out = np.empty((2, 2), kind)
    bin_image(np.full((8, 8), full, dtype), 4, 4, out)
    np.testing.assert_array_equal(unit * out, float(full))


def test_a_size_that_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="does not fill"):
        bin_image(np.zeros((12, 8), np.uint8), 4, 4, np.empty((2, 2), np.uint16))


def test_a_grid_of_another_kind_is_refused() -> None:
    with pytest.raises(ValueError, match="uint16"):
        bin_image(np.zeros((8, 8), np.uint8), 4, 4, np.empty((2, 2), np.float32))
