"""Bins are means."""

from __future__ import annotations

import numpy as np
import pytest

from endo3d_core.binning import bin_image


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("bin_px", [1, 2, 4])
def test_a_bin_is_the_mean_of_its_pixels(dtype: type[np.unsignedinteger], bin_px: int) -> None:
    image = np.random.default_rng(3).integers(0, np.iinfo(dtype).max, (24, 40), dtype, endpoint=True)
    out = np.empty((24 // bin_px, 40 // bin_px), np.float32)
    bin_image(image, bin_px, out)
    means = image.reshape(24 // bin_px, bin_px, 40 // bin_px, bin_px).mean((1, 3))
    np.testing.assert_allclose(out, means, rtol=1e-6)


def test_the_brightest_bin_does_not_overflow() -> None:
    out = np.empty((2, 2), np.float32)
    bin_image(np.full((8, 8), 255, np.uint8), 4, out)
    np.testing.assert_array_equal(out, 255.0)
    bin_image(np.full((8, 8), 65535, np.uint16), 4, out)
    np.testing.assert_array_equal(out, 65535.0)


def test_a_size_that_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="does not fill"):
        bin_image(np.zeros((12, 8), np.uint8), 4, np.empty((2, 2), np.float32))
