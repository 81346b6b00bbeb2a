"""High dynamic range: one sequence fused from several exposures, pixel by pixel.

Photon counts of the same light add, so the most likely estimate is the sum over all exposures in which no
pattern saturates (section 3.1; the weights of Mann and Picard for a linear camera with shot noise). The sum's
fringes keep their phase, and its grey values belong to the summed exposure time.
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
    right: int,
    exposures: NDArray[np.float32],
    saturation: float,
    fused: NDArray[np.float32],
    exposed: NDArray[np.float32],
    used: NDArray[np.float32],
) -> None:
    """Columns left..right of row v of frames (exposures * patterns, height, width) -> fused (patterns, columns).

    ``exposed`` (columns,) is the summed exposure, 0 where every exposure saturates (``fused`` is 0 there too);
    ``used`` is scratch (columns,).
    """
    count = exposures.size
    patterns = frames.shape[0] // count
    limit, zero, one = np.float32(saturation), np.float32(0.0), np.float32(1.0)
    exposed[:] = zero
    for p in range(patterns):
        fused[p, : exposed.size] = zero
    for e in range(count):
        used[:] = zero
        for p in range(patterns):
            row = frames[e * patterns + p, v, left:right]
            for x in range(used.size):
                used[x] = max(used[x], np.float32(row[x]))
        weight = exposures[e]
        for x in range(used.size):
            used[x] = one if used[x] < limit else zero
            exposed[x] += weight * used[x]
        for p in range(patterns):
            row, out = frames[e * patterns + p, v, left:right], fused[p]
            for x in range(used.size):
                out[x] += used[x] * np.float32(row[x])
