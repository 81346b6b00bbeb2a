"""High dynamic range: one sequence fused from several exposures, pixel by pixel.

Photon counts of the same light add, so the most likely estimate is the sum over all exposures in which no
pattern saturates (section 3.1; the weights of Mann and Picard for a linear camera with shot noise). The sum's
fringes keep their phase, and its grey values belong to the summed exposure time.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from endo3d_core.compiled import kernel


@kernel
def fuse_row(
    frames: NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float32],
    v: int,
    exposures: NDArray[np.float32],
    saturation: float,
    fused: NDArray[np.float32],
    exposed: NDArray[np.float32],
    brightest: NDArray[np.float32],
) -> None:
    """Row v of frames (exposures * patterns, height, width) -> fused (patterns or more, width).

    ``exposed`` (width,) is the summed exposure, 0 where every exposure saturates (``fused`` is 0 there too);
    ``brightest`` is scratch (width,).
    """
    count = exposures.size
    patterns = frames.shape[0] // count
    limit, zero = np.float32(saturation), np.float32(0.0)
    exposed[:] = zero
    fused[:] = zero
    for e in range(count):
        brightest[:] = zero
        for p in range(patterns):
            row = frames[e * patterns + p, v]
            for x in range(row.size):
                brightest[x] = max(brightest[x], np.float32(row[x]))
        weight = exposures[e]
        for x in range(exposed.size):
            brightest[x] = np.float32(1.0) if brightest[x] < limit else zero
            exposed[x] += weight * brightest[x]
        for p in range(patterns):
            row, out = frames[e * patterns + p, v], fused[p]
            for x in range(row.size):
                out[x] += brightest[x] * np.float32(row[x])
