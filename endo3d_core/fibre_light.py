"""The light of fibre cores, each from the few pixels of a camera's image that show it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d_core.compiled import kernel

WORD = 4
"""Pixels that are loaded at once."""
WORDS = {np.dtype(np.uint8): np.uint32, np.dtype(np.uint16): np.uint64}
SEEN_LEAST = 0.1
"""Of a core's light in the flat: when pixels with less of it don't saturate, the core's light is unknown."""


def average(
    image: NDArray[Any],
    spot: int,
    first: NDArray[np.uint32],
    fraction: NDArray[np.float32],
    limit: float,
    out: NDArray[np.float32],
) -> None:
    """Contiguous image (height, width) -> out (n,): means over ``spot`` x ``spot`` pixels about each core.

    ``first`` (n,) is the flat index of the spot's upper left pixel, ``fraction`` (2, n) how far right and
    down of it the spot begins. A core is negative where one of its pixels reaches ``limit``.
    """
    pixels, width = image.reshape(-1), image.shape[1]
    quick = {1: _average_1, 2: _average_2}.get(spot)
    if quick is None or image.dtype not in WORDS:
        _average_any(pixels, spot, width, first, fraction, np.float32(limit), out)
        return
    words = np.ndarray(pixels.size - WORD + 1, WORDS[image.dtype], pixels, strides=(image.itemsize,))
    quick(words, _clips(image.dtype, limit), 8 * image.itemsize, width, first, fraction, out)


def _clips(dtype: np.dtype[Any], limit: float) -> NDArray[Any]:
    """Three words that find a pixel of at least ``limit`` among a word's four: its lower bits, and its highest bit,
    ((w & [0]) + [1]) & w & [2]. Limits below half the range can't be told so; half the range is taken then, which
    only costs time.
    """
    bits = 8 * dtype.itemsize
    half, word = 1 << (bits - 1), WORDS[dtype]
    everywhere = sum(1 << (bits * k) for k in range(WORD))
    add = (half << 1) - int(np.clip(math.ceil(min(limit, 2 * half)), half, 2 * half))
    return np.array([everywhere * (half - 1), everywhere * min(add, half), everywhere * half], word)


@kernel
def _average_1(
    words: NDArray[Any],
    clips: NDArray[Any],
    bits: int,
    width: int,
    first: NDArray[np.uint32],
    fraction: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Each core's mean over a square of 1 pixel about its centre, to a fraction of a pixel.

    A word holds the four pixels from its place on. Negative where one of them may saturate (``_clips``).
    """
    w, mask, shift = np.uint32(width), words.dtype.type((1 << bits) - 1), words.dtype.type(bits)
    low, add, high = clips[0], clips[1], clips[2]
    for i in range(first.size):
        x, y = words[first[i]], words[first[i] + w]
        a, b = np.int32(x & mask), np.int32((x >> shift) & mask)
        c, d = np.int32(y & mask), np.int32((y >> shift) & mask)
        above = np.float32(a) + fraction[0, i] * np.float32(b - a)
        below = np.float32(c) + fraction[0, i] * np.float32(d - c)
        mean = above + fraction[1, i] * (below - above)
        bright = ((((x & low) + add) & x) | (((y & low) + add) & y)) & high
        out[i] = -mean if bright != 0 else mean


@kernel
def _average_2(
    words: NDArray[Any],
    clips: NDArray[Any],
    bits: int,
    width: int,
    first: NDArray[np.uint32],
    fraction: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """The same over a square of 2 pixels."""
    w, mask = np.uint32(width), words.dtype.type((1 << bits) - 1)
    shift, twice = words.dtype.type(bits), words.dtype.type(2 * bits)
    low, add, high, quarter = clips[0], clips[1], clips[2], np.float32(0.25)
    for i in range(first.size):
        p = first[i]
        x, y, z = words[p], words[p + w], words[p + w + w]
        a, b, c = np.int32(x & mask), np.int32((x >> shift) & mask), np.int32((x >> twice) & mask)
        d, e, f = np.int32(y & mask), np.int32((y >> shift) & mask), np.int32((y >> twice) & mask)
        g, h, k = np.int32(z & mask), np.int32((z >> shift) & mask), np.int32((z >> twice) & mask)
        fu, fv = fraction[0, i], fraction[1, i]
        top = np.float32(a + b) + fu * np.float32(c - a)
        middle = np.float32(d + e) + fu * np.float32(f - d)
        bottom = np.float32(g + h) + fu * np.float32(k - g)
        mean = quarter * (top + middle + fv * (bottom - top))
        bright = ((((x & low) + add) & x) | (((y & low) + add) & y) | (((z & low) + add) & z)) & high
        out[i] = -mean if bright != 0 else mean


@kernel
def _average_any(
    image: NDArray[Any],
    spot: int,
    width: int,
    first: NDArray[np.uint32],
    fraction: NDArray[np.float32],
    limit: np.float32,
    out: NDArray[np.float32],
) -> None:
    """The same over any square and for images of any kind."""
    share = np.float32(1.0 / (spot * spot))
    for i in range(first.size):
        mean, peak = np.float32(0.0), np.float32(0.0)
        for j in range(spot + 1):
            for k in range(spot + 1):
                grey = np.float32(image[np.int64(first[i]) + j * width + k])
                peak = max(peak, grey)
                mean += _weight(j, spot, fraction[1, i]) * _weight(k, spot, fraction[0, i]) * grey
        out[i] = -share * mean if peak >= limit else share * mean


@kernel
def _weight(pixel: int, spot: int, fraction: np.float32) -> np.float32:
    """Of a pixel of the spot + 1 that a spot of fractional place covers."""
    one = np.float32(1.0)
    return one - fraction if pixel == 0 else fraction if pixel == spot else one


@kernel
def complete(
    image: NDArray[Any],
    flat: NDArray[np.float32],
    spot: int,
    width: int,
    first: NDArray[np.uint32],
    fraction: NDArray[np.float32],
    limit: np.float32,
    out: NDArray[np.float32],
) -> None:
    """Cores marked negative -> their light as the pixels below ``limit`` show it, by their share of the flat's.

    Only a core's bright middle clips at first. Those with too little left stay marked.
    """
    share, zero = np.float32(1.0 / (spot * spot)), np.float32(0.0)
    for i in range(first.size):
        if out[i] >= zero:
            continue
        whole, lit, seen = zero, zero, zero
        for j in range(spot + 1):
            for k in range(spot + 1):
                p = np.int64(first[i]) + j * width + k
                weight = _weight(j, spot, fraction[1, i]) * _weight(k, spot, fraction[0, i])
                grey = np.float32(image[p])
                whole += weight * flat[p]
                if grey < limit:
                    lit += weight * flat[p]
                    seen += weight * grey
        if lit > np.float32(SEEN_LEAST) * whole:
            out[i] = share * whole * seen / lit
