"""Where a fibre is imaged on a pixel grid: a circle about the image's middle."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from endo3d_core.calibration import Lens


def middle(lens: Lens) -> NDArray[np.float64]:
    """(2,) pixel."""
    return np.array(((lens.width - 1) / 2, (lens.height - 1) / 2))


def inside(lens: Lens, pixels: NDArray[np.float64], circle_px: float) -> NDArray[np.bool_]:
    """(..., 2) pixels -> (...) whether the fibre is imaged there."""
    return np.asarray(np.sum((pixels - middle(lens)) ** 2, axis=-1) <= (circle_px / 2) ** 2)


def rim(lens: Lens, circle_px: float) -> NDArray[np.float64]:
    """(64, 3) rays with z = 1 through the circle's rim."""
    angle = np.arange(64) * (2 * math.pi / 64)
    return lens.ray(middle(lens) + circle_px / 2 * np.stack((np.cos(angle), np.sin(angle)), axis=-1))
