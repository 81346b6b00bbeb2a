"""Pattern images as a DLPC900 takes them: bit planes packed into 24-bit words, compressed, with a header.

Source: TI DLPU018, pattern-on-the-fly mode. Bit b of a 24-bit word is LUT bit position b; a word leaves most
significant byte first.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from endo3d_core.compiled import exact

BITS = 24
IMAGES = 18
"""What the controller's memory holds."""
ENHANCED_RLE = 2
HEADER = struct.Struct("<4sHHI8sIBBB21x")
HEADER_BYTES = HEADER.size


@dataclass(frozen=True, slots=True)
class Place:
    """Where a pattern is kept."""

    image: int
    bit: int
    """Its lowest bit position."""
    depth: int
    """Bits per pixel."""


def places(depths: Sequence[int], kinds: Sequence[object]) -> list[Place]:
    """Room for patterns of 1..8 bits: three of 8 bits or 24 of one bit per image.

    Patterns of different kinds share no image: columns among columns have equal lines, which compress well.
    Raises ``ValueError`` when the controller's memory does not hold them.
    """
    found: list[Place] = []
    open_images: dict[object, tuple[int, int]] = {}
    images = 0
    for depth, kind in zip(depths, kinds, strict=True):
        image, bit = open_images.get(kind, (0, BITS))
        bit = -(-bit // depth) * depth  # aligned, so that 8-bit patterns are whole bytes
        if bit + depth > BITS:
            image, bit = images, 0
            images += 1
        found.append(Place(image, bit, depth))
        open_images[kind] = image, bit + depth
    if images > IMAGES:
        raise ValueError(f"{len(depths)} patterns need {images} images of 24 bits; the projector holds {IMAGES}")
    return found


def pack(patterns: Sequence[tuple[Place, NDArray[np.uint8]]]) -> NDArray[np.uint8]:
    """(height, width, 3) uint8, most significant byte first, of the patterns of ONE image.

    A pattern's grey values must be below 2^depth.
    """
    words = np.zeros(patterns[0][1].shape, np.uint32)
    for place, pattern in patterns:
        words |= pattern.astype(np.uint32) << np.uint32(place.bit)
    return np.stack([(words >> shift).astype(np.uint8) for shift in (16, 8, 0)], axis=-1)


def upload(pixels: NDArray[np.uint8]) -> bytes:
    """Header and enhanced RLE of (height, width, 3) uint8: what the bytes of command 1A2B are."""
    height, width = pixels.shape[:2]
    compressed = encode(pixels)
    header = HEADER.pack(
        b"Spld", width, height, len(compressed), b"\xff" * 8, 0, 0, ENHANCED_RLE, 1
    )  # fmt: skip
    return header + compressed


def encode(pixels: NDArray[np.uint8]) -> bytes:
    """Enhanced RLE of (height, width, 3) uint8, rows top-down."""
    height, width = pixels.shape[:2]
    rgb = pixels.astype(np.uint32)
    words = np.ascontiguousarray(rgb[..., 0] << 16 | rgb[..., 1] << 8 | rgb[..., 2])
    out = np.empty(height * (4 * width + 4) + 3, np.uint8)  # nothing takes more than 4 bytes per pixel
    return out[: _encode(words, out)].tobytes()


@exact
def _encode(words: NDArray[np.uint32], out: NDArray[np.uint8]) -> int:
    """Each row from the left: the longer of a copy of the line above and a repeat, else literals."""
    height, width = words.shape
    end = 0
    for y in range(height):
        x = 0
        while x < width:
            repeated = _repeated(words[y], x)
            copied = _copied(words, y, x)
            if copied >= 2 and copied >= repeated:
                out[end], out[end + 1] = 0, 1
                end = _count(copied, out, end + 2)
                x += copied
                continue
            if repeated >= 2:
                end = _pixel(words[y, x], out, _count(repeated, out, end))
                x += repeated
                continue
            start = x
            while x < width and _repeated(words[y], x) < 2 and _copied(words, y, x) < 2:
                x += 1
            if x - start == 1:  # a literal of one would read as the code of a copy
                out[end] = 1
                end = _pixel(words[y, start], out, end + 1)
                continue
            out[end] = 0
            end = _count(x - start, out, end + 1)
            for i in range(start, x):
                end = _pixel(words[y, i], out, end)
    out[end : end + 3] = np.array((0, 1, 0), np.uint8)  # end of image
    return end + 3


@exact
def _repeated(line: NDArray[np.uint32], x: int) -> int:
    """How many pixels from x on are the same."""
    end = x + 1
    while end < line.size and line[end] == line[x]:
        end += 1
    return end - x


@exact
def _copied(words: NDArray[np.uint32], y: int, x: int) -> int:
    """How many pixels from x on are those of the line above."""
    end = x
    if y > 0:
        while end < words.shape[1] and words[y, end] == words[y - 1, end]:
            end += 1
    return end - x


@exact
def _count(n: int, out: NDArray[np.uint8], end: int) -> int:
    if n < 128:
        out[end] = n
        return end + 1
    out[end], out[end + 1] = (n & 0x7F) | 0x80, n >> 7
    return end + 2


@exact
def _pixel(word: int, out: NDArray[np.uint8], end: int) -> int:
    out[end], out[end + 1], out[end + 2] = word >> 16 & 0xFF, word >> 8 & 0xFF, word & 0xFF
    return end + 3
