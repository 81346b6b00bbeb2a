"""Pooling of an organised cloud: 2x2 cells become one, behind a median gate that stops outliers.

Planes are (6, rows, columns) float32: x, y, z, intensity, texture, sigma. NaN is invalid.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d_core.compiled import kernel

X, Y, Z, INTENSITY, TEXTURE, SIGMA = range(6)
PLANES = 6

_GATE_SIGMAS = 4.0


@kernel
def _median(a: Any, b: Any, c: Any, d: Any) -> Any:
    """Of four; a NaN takes a neighbour's value, which leaves the middle of what is valid."""
    a = a if a == a else (b if b == b else d)
    b = b if b == b else (a if a == a else c)
    c = c if c == c else (d if d == d else b)
    d = d if d == d else (c if c == c else a)
    low, high = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
    return np.float32(0.5) * (((a + b) + (c + d)) - low - high)


@kernel
def _weight(z: Any, sigma: Any, median: Any, slope: Any) -> Any:
    near = abs(z - median) <= np.float32(_GATE_SIGMAS) * sigma + slope
    return np.float32(1.0) / (sigma * sigma) if near else np.float32(0.0)


@kernel
def pool(channels: NDArray[np.float32], slope_mm: float, planes: NDArray[np.float32]) -> int:
    """(height, width, 6) float32 x y z intensity quality sigma -> planes; returns the number of valid cells.

    A cell stays when its z is within four sigmas plus ``slope_mm`` (what a steep surface may differ between
    neighbours) of the median of its four; two or more have to. Means are weighted by 1/sigma^2.
    """
    slope, zero, nan = np.float32(slope_mm), np.float32(0.0), np.float32(np.nan)
    count = 0
    for r in range(planes.shape[1]):
        top, low = channels[2 * r], channels[2 * r + 1]
        for c in range(planes.shape[2]):
            i, j = 2 * c, 2 * c + 1
            median = _median(top[i, 2], top[j, 2], low[i, 2], low[j, 2])
            wa, wb = _weight(top[i, 2], top[i, 5], median, slope), _weight(top[j, 2], top[j, 5], median, slope)
            wc, wd = _weight(low[i, 2], low[i, 5], median, slope), _weight(low[j, 2], low[j, 5], median, slope)
            kept = int(wa > zero) + int(wb > zero) + int(wc > zero) + int(wd > zero)
            if kept < 2:
                for k in range(planes.shape[0]):
                    planes[k, r, c] = nan
                continue
            scale = np.float32(1.0) / (wa + wb + wc + wd)
            for k in range(4):
                if kept == 4:
                    total = wa * top[i, k] + wb * top[j, k] + wc * low[i, k] + wd * low[j, k]
                else:  # zero times NaN is NaN
                    total = wa * top[i, k] if wa > zero else zero
                    total += wb * top[j, k] if wb > zero else zero
                    total += wc * low[i, k] if wc > zero else zero
                    total += wd * low[j, k] if wd > zero else zero
                planes[k, r, c] = scale * total
            planes[5, r, c] = np.sqrt(scale)
            count += 1
    return count


@kernel
def high_pass(planes: NDArray[np.float32], half: int, work: NDArray[np.float64]) -> None:
    """Texture = intensity over its mean in a (2 half + 1)^2 box, minus one: shading and exposure cancel.

    work (4, columns + 1) float64 is scratch.
    """
    rows, columns = planes.shape[1], planes.shape[2]
    grey, texture = planes[3], planes[4]
    total, count, sum_total, sum_count = work[0], work[1], work[2], work[3]
    total[:] = 0.0
    count[:] = 0.0
    for r in range(-half, rows):
        entering, leaving = r + half, r - half - 1
        if entering < rows:
            for c in range(columns):
                if grey[entering, c] == grey[entering, c]:
                    total[c] += grey[entering, c]
                    count[c] += 1.0
        if leaving >= 0:
            for c in range(columns):
                if grey[leaving, c] == grey[leaving, c]:
                    total[c] -= grey[leaving, c]
                    count[c] -= 1.0
        if r < 0:
            continue
        sum_total[0] = 0.0
        sum_count[0] = 0.0
        for c in range(columns):
            sum_total[c + 1] = sum_total[c] + total[c]
            sum_count[c + 1] = sum_count[c] + count[c]
        for c in range(columns):
            low, high = max(c - half, 0), min(c + half + 1, columns)
            mean = (sum_total[high] - sum_total[low]) / max(sum_count[high] - sum_count[low], 1.0)
            texture[r, c] = np.float32(grey[r, c] / max(mean, 1e-6) - 1.0)
