"""Numbers to colours, the same in Rerun, in pictures and in figures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

RAMPS = {
    "height": ("#54398f", "#4459ab", "#2f7fb5", "#21a3a3", "#4cc088", "#a3d85f", "#f6e354"),
    "quality": ("#3b0f26", "#8c1f3c", "#d1493f", "#f08f4f", "#f8cf78", "#dfeeb0", "#7fd0a0"),
    "deviation": ("#1c3f8f", "#3f7fc4", "#93c0e2", "#f2f2f0", "#f0b48c", "#d8663f", "#8f1f22"),
}
"""Ends and equidistant steps of each ramp: lightness grows with height, deviation is white at zero."""

MISSING = np.array([90, 90, 96], np.uint8)


def table(name: str) -> NDArray[np.uint8]:
    """(256, 3) uint8 RGB of a ramp."""
    stops = np.array([[int(code[i : i + 2], 16) for i in (1, 3, 5)] for code in RAMPS[name]], float)
    at = np.linspace(0, len(stops) - 1, 256)
    channels = [np.interp(at, np.arange(len(stops)), stops[:, k]) for k in range(3)]
    return np.stack(channels, axis=1).round().astype(np.uint8)


TABLES = {name: table(name) for name in RAMPS}


def coloured(values: NDArray[np.floating], low: float, high: float, ramp: str) -> NDArray[np.uint8]:
    """(..., 3) uint8 RGB of values, ``low``..``high`` (may be the smaller) over the ramp; NaN is grey."""
    valid = np.isfinite(values)
    at = np.where(valid, (values - low) * (255.0 / (high - low)), 0.0)
    rgb = TABLES[ramp][np.clip(at, 0, 255).astype(np.uint8)]
    rgb[~valid] = MISSING
    return rgb


def packed(rgb: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """(n,) uint32 0xRRGGBBAA of (n, 3) uint8, opaque: what Rerun takes without converting."""
    abgr = np.full((len(rgb), 4), 255, np.uint8)
    abgr[:, :0:-1] = rgb
    return abgr.view("<u4")[:, 0]


def spread(values: NDArray[np.floating], share: float = 0.02) -> tuple[float, float]:
    """The range of the values without the outermost ``share`` at both ends, never empty; (0, 1) of none."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return 0.0, 1.0
    low, high = np.quantile(finite, [share, 1 - share])
    return (float(low), float(high)) if high > low else (float(low) - 0.5, float(low) + 0.5)
