"""Camera image -> float32 grid of bin means, and back to camera coordinates.

A fibre core covers 12 to 23 pixels of a 1920x1200 camera: a 4x4-binned grid is near the fibre's own
resolution, and everything after it costs a sixteenth.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from endo3d_core.compiled import kernel

BINS = (1, 2, 4)

Image = NDArray[np.uint8] | NDArray[np.uint16]
_WORDS = {(1, 2): np.uint16, (1, 4): np.uint32, (2, 2): np.uint32, (2, 4): np.uint64}


def bin_image(image: Image, bin_px: int, out: NDArray[np.float32]) -> None:
    """(height, width) uint8 or uint16 -> out (height/bin, width/bin) float32: each bin's mean;
    a last part of a bin at the right and the bottom is left out.
    """
    height, width = out.shape[0] * bin_px, out.shape[1] * bin_px
    spare = (image.shape[0] - height, image.shape[1] - width)
    if bin_px not in BINS or not all(0 <= px < bin_px for px in spare):
        raise ValueError(f"an image of {image.shape} does not fill {out.shape} bins of {bin_px} px")
    image = image[:height, :width]
    if bin_px == 1:
        out[:] = image
        return
    words = np.ascontiguousarray(image).view(_WORDS[image.itemsize, bin_px])
    if image.itemsize == 1:
        (_bin2_8 if bin_px == 2 else _bin4_8)(words, out)
    else:
        (_bin2_16 if bin_px == 2 else _bin4_16)(words, out)


# A word holds the bin's pixels of one row: masks and shifts add them without leaving the SIMD lane.


@kernel
def _bin2_8(words: NDArray[np.uint16], out: NDArray[np.float32]) -> None:
    quarter = np.float32(0.25)
    for v in range(out.shape[0]):
        a, b, row = words[2 * v], words[2 * v + 1], out[v]
        for u in range(row.size):
            low = np.int32(a[u] & np.uint16(0xFF)) + np.int32(b[u] & np.uint16(0xFF))
            high = np.int32(a[u] >> np.uint16(8)) + np.int32(b[u] >> np.uint16(8))
            row[u] = np.float32(low + high) * quarter


@kernel
def _bin4_8(words: NDArray[np.uint32], out: NDArray[np.float32]) -> None:
    even, half, byte = np.uint32(0x00FF00FF), np.uint32(0xFFFF), np.uint32(8)
    sixteenth = np.float32(1.0 / 16.0)
    for v in range(out.shape[0]):
        a, b, c, d, row = words[4 * v], words[4 * v + 1], words[4 * v + 2], words[4 * v + 3], out[v]
        for u in range(row.size):
            pairs = (a[u] & even) + ((a[u] >> byte) & even) + (b[u] & even) + ((b[u] >> byte) & even)
            pairs += (c[u] & even) + ((c[u] >> byte) & even) + (d[u] & even) + ((d[u] >> byte) & even)
            row[u] = np.float32(np.int32((pairs & half) + (pairs >> np.uint32(16)))) * sixteenth


@kernel
def _bin2_16(words: NDArray[np.uint32], out: NDArray[np.float32]) -> None:
    half, shift, quarter = np.uint32(0xFFFF), np.uint32(16), np.float32(0.25)
    for v in range(out.shape[0]):
        a, b, row = words[2 * v], words[2 * v + 1], out[v]
        for u in range(row.size):
            total = (a[u] & half) + (a[u] >> shift) + (b[u] & half) + (b[u] >> shift)
            row[u] = np.float32(np.int32(total)) * quarter


@kernel
def _bin4_16(words: NDArray[np.uint64], out: NDArray[np.float32]) -> None:
    even, word, shift = np.uint64(0x0000FFFF0000FFFF), np.uint64(0xFFFFFFFF), np.uint64(16)
    sixteenth = np.float32(1.0 / 16.0)
    for v in range(out.shape[0]):
        row = out[v]
        for u in range(row.size):
            pairs = np.uint64(0)
            for i in range(4):
                four = words[4 * v + i, u]
                pairs += (four & even) + ((four >> shift) & even)
            total = (pairs & word) + (pairs >> np.uint64(32))
            row[u] = np.float32(np.int64(total)) * sixteenth
