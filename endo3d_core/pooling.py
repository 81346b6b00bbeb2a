"""Pooling of an organised cloud: 2x2 cells become one, behind a median gate that stops outliers.

A cloud that is ready for registration consists of planes (PLANES, rows, columns) float32, NaN where invalid: of each
line of the grid only what is needed is read, in order, and the loops vectorise.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d_core.compiled import kernel

X, Y, Z = 0, 1, 2
"""Point in the camera's axes, mm."""
NX, NY, NZ = 3, 4, 5
"""Unit normal towards the camera."""
TEXTURE = 6
"""Intensity over that of its surroundings, minus one."""
GX, GY, GZ = 7, 8, 9
"""The texture's gradient per mm along the surface, in the camera's axes."""
WEIGHT = 10
"""1/sigma^2 of the depth, 1/mm^2."""
GREY = 11
"""Intensity."""
TEXTURE_WEIGHT = 12
"""The square of the surroundings' brightness, relative to the whole cloud's."""
PLANES = 13

_GATE_SIGMAS = 4.0
_CHANNELS = 6
_KEPT = (0, 1, 2, 3, 5)
SPAN = 512
"""Cells of a line that are pooled at a time."""


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
    weight = np.float32(1.0) / (sigma * sigma)
    return weight if abs(z - median) <= np.float32(_GATE_SIGMAS) * sigma + slope * median else np.float32(0.0)


@kernel
def _split(line: NDArray[np.float32], cells: NDArray[np.float32]) -> None:
    """Cells of a line (width * 6,) of the grid -> (5, SPAN): a row for each channel but quality."""
    for row in range(5):
        out, channel = cells[row], line[_KEPT[row] :]
        for i in range(line.size // _CHANNELS):
            out[i] = channel[_CHANNELS * i]


@kernel
def pool(
    lines: NDArray[np.float32],
    slope: float,
    cells: NDArray[np.float32],
    weights: NDArray[np.float32],
    planes: NDArray[np.float32],
) -> int:
    """lines (height, width * 6) float32 of x y z intensity quality sigma -> X, Y, Z, GREY and WEIGHT of planes.

    Returns the number of valid cells. A cell stays when its z is within four sigmas plus ``slope`` times the median of
    its four (what a steep surface may differ between neighbours) of that median; two or more have to. Means are
    weighted by 1/sigma^2. cells (2, 5, SPAN) and weights (5, SPAN) are scratch.
    """
    count = 0
    for r in range(planes.shape[1]):
        for first in range(0, planes.shape[2], SPAN // 2):
            last = min(first + SPAN // 2, planes.shape[2])
            part = slice(2 * _CHANNELS * first, 2 * _CHANNELS * last)
            _split(lines[2 * r, part], cells[0])
            _split(lines[2 * r + 1, part], cells[1])
            total = planes[WEIGHT, r, first:last]
            count += _weigh(cells[0, 2], cells[0, 4], cells[1, 2], cells[1, 4], slope, weights, total)
            for plane, channel in ((X, 0), (Y, 1), (Z, 2), (GREY, 3)):
                _average(cells[0, channel], cells[1, channel], weights, planes[plane, r, first:last])
    return count


@kernel
def _weigh(
    top_z: NDArray[np.float32],
    top_sigma: NDArray[np.float32],
    low_z: NDArray[np.float32],
    low_sigma: NDArray[np.float32],
    slope: float,
    weights: NDArray[np.float32],
    sums: NDArray[np.float32],
) -> int:
    """The weights of each cell's four points, zero for an outlier; their sum, and one over it."""
    steep, zero, one, two, nan = np.float32(slope), np.float32(0), np.float32(1), np.float32(2), np.float32(np.nan)
    row_a, row_b, row_e, row_f, row_inverse = weights[0], weights[1], weights[2], weights[3], weights[4]
    count = zero
    for c in range(sums.size):
        a, b, e, f = top_z[2 * c], top_z[2 * c + 1], low_z[2 * c], low_z[2 * c + 1]
        sa, sb, se, sf = top_sigma[2 * c], top_sigma[2 * c + 1], low_sigma[2 * c], low_sigma[2 * c + 1]
        median = _median(a, b, e, f)
        wa, wb = _weight(a, sa, median, steep), _weight(b, sb, median, steep)
        we, wf = _weight(e, se, median, steep), _weight(f, sf, median, steep)
        kept = (one if wa > zero else zero) + (one if wb > zero else zero)
        kept += (one if we > zero else zero) + (one if wf > zero else zero)
        total, inverse = wa + wb + we + wf, one / (wa + wb + we + wf)
        sums[c] = total if kept >= two else nan
        count += one if kept >= two else zero
        row_a[c], row_b[c], row_e[c], row_f[c] = wa, wb, we, wf
        row_inverse[c] = inverse if kept >= two else nan
    return int(count)


@kernel
def _average(
    top: NDArray[np.float32], low: NDArray[np.float32], weights: NDArray[np.float32], mean: NDArray[np.float32]
) -> None:
    zero = np.float32(0.0)
    row_a, row_b, row_e, row_f, row_inverse = weights[0], weights[1], weights[2], weights[3], weights[4]
    for c in range(mean.size):
        a, b, e, f = top[2 * c], top[2 * c + 1], low[2 * c], low[2 * c + 1]
        wa, wb, we, wf = row_a[c], row_b[c], row_e[c], row_f[c]
        # Zero times NaN is NaN.
        total = (wa * a if wa > zero else zero) + (wb * b if wb > zero else zero)
        total += (we * e if we > zero else zero) + (wf * f if wf > zero else zero)
        mean[c] = total * row_inverse[c]


@kernel
def high_pass(planes: NDArray[np.float32], half: int, work: NDArray[np.float32]) -> None:
    """TEXTURE from GREY: intensity over its mean in a (2 half + 1)^2 box, minus one: shading and exposure cancel.

    work (4, columns + 1) is scratch.
    """
    rows, columns = planes.shape[1], planes.shape[2]
    total, count, sum_total, sum_count = work[0], work[1], work[2], work[3]
    zero, one, least = np.float32(0.0), np.float32(1.0), np.float32(1e-6)
    total[:] = zero
    count[:] = zero
    for r in range(-half, rows):
        if r + half < rows:
            entering = planes[GREY, r + half]
            for c in range(columns):
                grey = entering[c]
                total[c] += grey if grey == grey else zero
                count[c] += one if grey == grey else zero
        if r - half - 1 >= 0:
            leaving = planes[GREY, r - half - 1]
            for c in range(columns):
                grey = leaving[c]
                total[c] -= grey if grey == grey else zero
                count[c] -= one if grey == grey else zero
        if r < 0:
            continue
        running = running_count = 0.0
        sum_total[0] = sum_count[0] = zero
        for c in range(columns):
            running += total[c]
            running_count += count[c]
            sum_total[c + 1] = running
            sum_count[c + 1] = running_count
        grey_row, texture = planes[GREY, r], planes[TEXTURE, r]
        for c in range(half):
            high = min(c + half + 1, columns)
            texture[c] = grey_row[c] * max(sum_count[high], one) / max(sum_total[high], least) - one
        for c in range(half, columns - half):
            boxed, cells = sum_total[c + half + 1] - sum_total[c - half], sum_count[c + half + 1] - sum_count[c - half]
            texture[c] = grey_row[c] * max(cells, one) / max(boxed, least) - one
        for c in range(max(columns - half, half), columns):
            boxed, cells = sum_total[columns] - sum_total[c - half], sum_count[columns] - sum_count[c - half]
            texture[c] = grey_row[c] * max(cells, one) / max(boxed, least) - one
