"""Camera image -> grid of bins.

A fibre core covers 12 to 23 pixels of a 1920x1200 camera: a 4x4-binned grid is near the fibre's own
resolution, and everything after it costs a sixteenth. Bins need not be square: a band-pass that is wider than a
fringe is computed on every fourth column without loss, whatever the rows.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from endo3d_core.compiled import kernel

BINS = (1, 2, 4)

Image = NDArray[np.uint8] | NDArray[np.uint16]
Grid = NDArray[Any]
"""(rows, columns), what ``grid_of`` says."""


def grid_of(image_dtype: DTypeLike, columns: int, rows: int) -> tuple[type[np.uint16] | type[np.float32], float]:
    """The grid's dtype and grey values per unit: sums of 8-bit pixels fit 16 bits, of others it holds the means."""
    return (np.uint16, 1.0 / (columns * rows)) if np.dtype(image_dtype) == np.uint8 else (np.float32, 1.0)


def bin_image(image: Image, columns: int, rows: int, out: Grid) -> None:
    """(height, width) image -> out (height/rows, width/columns): uint16 sums of uint8, float32 means of uint16.

    A last part of a bin at the right and the bottom is left out.
    """
    height, width = out.shape[0] * rows, out.shape[1] * columns
    spare = (image.shape[0] - height, image.shape[1] - width)
    if not (columns in BINS and rows in BINS and 0 <= spare[0] < rows and 0 <= spare[1] < columns):
        raise ValueError(f"an image of {image.shape} does not fill {out.shape} bins of {columns}x{rows} px")
    dtype, _ = grid_of(image.dtype, columns, rows)
    if out.dtype != dtype:
        raise ValueError(f"bins of {image.dtype} pixels are {np.dtype(dtype)}, not {out.dtype}")
    image = image[:height, :width]
    if columns == 1:
        _add_pixels(image, rows, out)
    else:
        word, add = _ADDERS[image.itemsize, columns]
        add(np.ascontiguousarray(image).view(word), rows, out)
    if image.itemsize == 2 and columns * rows > 1:
        np.multiply(out, np.float32(1.0 / (columns * rows)), out=out)


@kernel
def _add_pixels(image: Image, rows: int, out: Grid) -> None:
    for v in range(out.shape[0]):
        row, first = out[v], image[rows * v]
        for u in range(row.size):
            row[u] = first[u]
        for i in range(1, rows):
            more = image[rows * v + i]
            for u in range(row.size):
                row[u] += more[u]


# A word holds one row of a bin: masks and shifts add its pixels without leaving the SIMD lane.


@kernel
def _add_pairs_8(words: NDArray[np.uint16], rows: int, out: NDArray[np.uint16]) -> None:
    byte, low = np.uint16(8), np.uint16(0xFF)
    for v in range(out.shape[0]):
        row = out[v]
        row[:] = np.uint16(0)
        for i in range(rows):
            word = words[rows * v + i]
            for u in range(row.size):
                row[u] += np.uint16(word[u] & low) + np.uint16(word[u] >> byte)


@kernel
def _add_fours_8(words: NDArray[np.uint32], rows: int, out: NDArray[np.uint16]) -> None:
    even, half, byte, two = np.uint32(0x00FF00FF), np.uint32(0xFFFF), np.uint32(8), np.uint32(16)
    # Four rows at once; of those that a bin doesn't have, nothing is left by the mask.
    second, more, last = even if rows > 1 else np.uint32(0), even if rows > 2 else np.uint32(0), rows - 1
    for v in range(out.shape[0]):
        row, first = out[v], rows * v
        a, b = words[first], words[first + min(1, last)]
        c, d = words[first + min(2, last)], words[first + last]
        for u in range(row.size):
            pairs = (a[u] & even) + ((a[u] >> byte) & even) + (b[u] & second) + ((b[u] >> byte) & second)
            pairs += (c[u] & more) + ((c[u] >> byte) & more) + (d[u] & more) + ((d[u] >> byte) & more)
            row[u] = np.uint16((pairs & half) + (pairs >> two))


@kernel
def _add_pairs_16(words: NDArray[np.uint32], rows: int, out: NDArray[np.float32]) -> None:
    half, shift = np.uint32(0xFFFF), np.uint32(16)
    for v in range(out.shape[0]):
        row = out[v]
        row[:] = np.float32(0.0)
        for i in range(rows):
            word = words[rows * v + i]
            for u in range(row.size):
                row[u] += np.float32(np.int32((word[u] & half) + (word[u] >> shift)))


@kernel
def _add_fours_16(words: NDArray[np.uint64], rows: int, out: NDArray[np.float32]) -> None:
    even, half, one, two = np.uint64(0x0000FFFF0000FFFF), np.uint64(0xFFFFFFFF), np.uint64(16), np.uint64(32)
    for v in range(out.shape[0]):
        row = out[v]
        row[:] = np.float32(0.0)
        for i in range(rows):
            word = words[rows * v + i]
            for u in range(row.size):
                pairs = (word[u] & even) + ((word[u] >> one) & even)
                row[u] += np.float32(np.int64((pairs & half) + (pairs >> two)))


_ADDERS: dict[tuple[int, int], tuple[Any, Callable[..., None]]] = {
    (1, 2): (np.uint16, _add_pairs_8),
    (1, 4): (np.uint32, _add_fours_8),
    (2, 2): (np.uint32, _add_pairs_16),
    (2, 4): (np.uint64, _add_fours_16),
}
"""By the bytes of a pixel and the columns of a bin: the word that holds them, and the loop."""
