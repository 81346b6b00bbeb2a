"""High dynamic range: one sequence fused from several exposures, pixel by pixel.

Photon counts of the same light add, so the most likely estimate is the sum over all exposures in which no
pattern saturates (section 3.1; the weights of Mann and Picard for a linear camera with shot noise). The sum's
fringes keep their phase, and its grey values belong to the summed exposure time. A single exposure is the same with
one term.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d_core.compiled import kernel


@kernel
def fuse_row(
    frames: NDArray[Any],
    v: int,
    left: int,
    exposures: NDArray[np.float32],
    saturation: Any,
    brightest: NDArray[Any],
    fused: NDArray[Any],
    exposed: NDArray[np.float32],
) -> None:
    """Row v of frames (exposures * patterns, height, width), from column ``left`` on -> fused (patterns, columns).

    ``exposed`` (columns,) is the summed exposure, 0 where every exposure saturates (``fused`` is 0 there too).
    ``saturation`` and the scratch ``brightest`` (columns,) have the frames' dtype; ``fused`` holds their sum.
    """
    patterns, columns, zero = fused.shape[0], exposed.size, np.float32(0.0)
    for e in range(exposures.size):
        first, weight, kept = e * patterns, exposures[e], np.float32(0.0 if e == 0 else 1.0)
        _maximum(frames[first, v, left : left + columns], frames[first + 1, v, left : left + columns], brightest)
        for p in range(2, patterns):
            _maximum(brightest, frames[first + p, v, left : left + columns], brightest)
        for x in range(columns):
            exposed[x] = kept * exposed[x] + (weight if brightest[x] < saturation else zero)
        for p in range(patterns):
            _add_unsaturated(frames[first + p, v, left : left + columns], brightest, saturation, e == 0, fused[p])


@kernel
def _maximum(a: NDArray[Any], b: NDArray[Any], out: NDArray[Any]) -> None:
    for x in range(out.size):
        p, q = a[x], b[x]
        out[x] = p if p > q else q


@kernel
def _add_unsaturated(
    row: NDArray[Any], brightest: NDArray[Any], saturation: Any, first: bool, out: NDArray[Any]
) -> None:
    if first:
        for x in range(out.size):
            g = row[x]
            out[x] = g if brightest[x] < saturation else 0
    else:
        for x in range(out.size):
            g = row[x]
            out[x] += g if brightest[x] < saturation else 0
