"""A cloud's own axes, and height over its mean plane."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SAMPLE = 50_000


def principal(
    points: NDArray[np.floating], viewer: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(3, 3) rows along, across and up (towards the viewer), and the centre (3,), of (n, 3) finite points."""
    sample = points[:: max(1, len(points) // SAMPLE)].astype(float)
    centre = sample.mean(axis=0)
    spread = sample - centre
    along, _, up = np.linalg.svd(spread.T @ spread)[2]
    up = up if up @ (viewer - centre) > 0 else -up
    along = along if along[np.argmax(abs(along))] > 0 else -along
    return np.stack([along, np.cross(up, along), up]), centre


def without_strays(points: NDArray[np.floating]) -> NDArray[np.floating]:
    """Those of (n, 3) points that a view should be chosen by: a few far ones must not make all others small."""
    low, high = np.quantile(points, [0.003, 0.997], axis=0)
    margin = 0.05 * (high - low)
    kept: NDArray[np.floating] = points[((points >= low - margin) & (points <= high + margin)).all(axis=1)]
    return kept


def heights_mm(points: NDArray[np.floating], viewer: NDArray[np.floating]) -> NDArray[np.float64]:
    """(n,) height of every point over the mean plane, towards the viewer; NaN where a point is."""
    finite = points[np.isfinite(points).all(axis=1)]
    if len(finite) < 3:
        return np.zeros(len(points))
    axes, centre = principal(finite, viewer)
    return np.asarray((points - centre) @ axes[2])
