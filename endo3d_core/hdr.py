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
    patterns, columns = fused.shape[0], exposed.size
    for e in range(exposures.size):
        first = e * patterns
        brightest[:] = 0
        for p in range(patterns):
            _raise_to(frames[first + p, v, left : left + columns], brightest)
        _add_exposure(brightest, saturation, exposures[e], e == 0, exposed)
        for p in range(patterns):
            _add_unsaturated(frames[first + p, v, left : left + columns], brightest, saturation, e == 0, fused[p])


@kernel
def _raise_to(row: NDArray[Any], out: NDArray[Any]) -> None:
    for x in range(out.size):
        p, q = row[x], out[x]
        out[x] = p if p > q else q


@kernel
def _add_exposure(
    brightest: NDArray[Any], saturation: Any, exposure: np.float32, first: bool, out: NDArray[np.float32]
) -> None:
    zero, kept = np.float32(0.0), np.float32(0.0 if first else 1.0)
    for x in range(out.size):
        before = out[x]
        out[x] = kept * before + (exposure if brightest[x] < saturation else zero)


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
