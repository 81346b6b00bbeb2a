"""Which points are there."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def finite(points: NDArray[Any]) -> NDArray[Any]:
    """(n,) those of structured points of any shape that have a position."""
    flat = points.reshape(-1)
    there: NDArray[Any] = flat[np.isfinite(flat["x"]) & np.isfinite(flat["y"]) & np.isfinite(flat["z"])]
    return there


def xyz_mm(points: NDArray[Any]) -> NDArray[np.float64]:
    """(n, 3) positions."""
    return np.stack([points[axis] for axis in ("x", "y", "z")], axis=-1).astype(np.float64)
