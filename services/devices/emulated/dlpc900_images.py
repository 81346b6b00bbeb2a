"""What a DLPC900 makes of an uploaded image: header, decompression, bit planes.

Source: TI DLPU018 (programmer's guide), pattern-on-the-fly image format. This is the device's side, the
decoder; nothing here is shared with the driver's encoder.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

HEADER = struct.Struct("<4sHHI8sIBBB21s")
"""Signature, width, height, data bytes, 8 x FF, background, 0, compression, 1, padding: 48 bytes."""

UNCOMPRESSED, RLE, ENHANCED_RLE = 0, 1, 2


class BadImage(ValueError):
    """An upload the device can't read; ``code`` is what its error register then shows."""

    def __init__(self, text: str, code: int) -> None:
        super().__init__(text)
        self.code = code


BMP_COMPRESSION, BMP_MISSING = 9, 11


@dataclass(frozen=True, slots=True)
class ImageHeader:
    width: int
    height: int
    data_bytes: int
    compression: int


def read_header(blob: bytes) -> ImageHeader:
    """The 48-byte header in front of an image; raises ``BadImage``."""
    if len(blob) < HEADER.size:
        raise BadImage(f"{len(blob)} bytes are no image: the header alone has {HEADER.size}", BMP_MISSING)
    signature, width, height, size, marks, _, reserved, compression, version, pad = HEADER.unpack_from(blob)
    if signature != b"Spld" or marks != b"\xff" * 8 or reserved != 0 or version != 1 or any(pad):
        raise BadImage("the header is not that of a pattern image", BMP_MISSING)
    if compression not in (UNCOMPRESSED, RLE, ENHANCED_RLE):
        raise BadImage(f"compression {compression} does not exist", BMP_COMPRESSION)
    return ImageHeader(width, height, size, compression)


def decode_words(blob: bytes) -> NDArray[np.uint32]:
    """The (height, width) 24-bit words of an uploaded image; raises ``BadImage``."""
    header = read_header(blob)
    body = blob[HEADER.size :]
    if len(body) != header.data_bytes:
        raise BadImage(f"the header announces {header.data_bytes} bytes, {len(body)} came", BMP_MISSING)
    pixels = header.width * header.height
    match header.compression:
        case 0:
            flat = _words(body)
        case 1:
            flat = _expand_rle(body, header.width, pixels, enhanced=False)
        case _:
            flat = _expand_rle(body, header.width, pixels, enhanced=True)
    if flat.size != pixels:
        raise BadImage(f"{flat.size} pixels came for {header.width} x {header.height}", BMP_COMPRESSION)
    return flat.reshape(header.height, header.width)


def bit_plane(words: NDArray[np.uint32], position: int, depth: int) -> NDArray[np.uint8]:
    """The (height, width) grey values a pattern of ``depth`` bits at ``position`` shows."""
    return (words >> np.uint32(position) & np.uint32((1 << depth) - 1)).astype(np.uint8)


def _words(body: bytes) -> NDArray[np.uint32]:
    """Three bytes a pixel, most significant first."""
    if len(body) % 3:
        raise BadImage(f"{len(body)} bytes are no whole number of 24-bit pixels", BMP_COMPRESSION)
    red_first = np.frombuffer(body, np.uint8).reshape(-1, 3).astype(np.uint32)
    return (red_first[:, 0] << 16 | red_first[:, 1] << 8 | red_first[:, 2]).astype(np.uint32, copy=False)


class _Stream:
    def __init__(self, body: bytes) -> None:
        self.body = body
        self.at = 0

    def byte(self) -> int:
        if self.at >= len(self.body):
            raise BadImage("the compressed image ends in the middle", BMP_COMPRESSION)
        value = self.body[self.at]
        self.at += 1
        return value

    def count(self) -> int:
        """One byte below 128, else seven low bits with bit 7 set, then the rest divided by 128."""
        low = self.byte()
        return low if low < 128 else (low & 0x7F) + (self.byte() << 7)

    def pixel(self) -> int:
        return self.byte() << 16 | self.byte() << 8 | self.byte()

    def pixels(self, count: int) -> NDArray[np.uint32]:
        start, self.at = self.at, self.at + 3 * count
        if self.at > len(self.body):
            raise BadImage("the compressed image ends in the middle", BMP_COMPRESSION)
        return _words(self.body[start : self.at])


def _expand_rle(body: bytes, width: int, pixels: int, *, enhanced: bool) -> NDArray[np.uint32]:
    """Runs, literals, line copies and ends of line until the end-of-image mark."""
    out = np.zeros(pixels, np.uint32)
    filled = 0
    for kind, count, values in _commands(_Stream(body), enhanced):
        if kind == "end of line":
            filled = -(-filled // width) * width
            continue
        if filled + count > pixels:
            raise BadImage(f"more than {pixels} pixels", BMP_COMPRESSION)
        if kind == "previous line":
            if filled < width:
                raise BadImage("the first line has no previous line to copy", BMP_COMPRESSION)
            for start in range(filled, filled + count, width):  # a copy may run on over its own output
                stop = min(start + width, filled + count)
                out[start:stop] = out[start - width : stop - width]
        else:
            out[filled : filled + count] = values
        filled += count
    return out[:filled]


def _commands(stream: _Stream, enhanced: bool) -> Iterator[tuple[str, int, int | NDArray[np.uint32]]]:
    while True:
        repeat = stream.count() if enhanced else stream.byte()
        if repeat:
            yield "run", repeat, stream.pixel()
            continue
        control = stream.count() if enhanced else stream.byte()
        if control == 0:
            yield "end of line", 0, 0
        elif control == 1:
            copied = stream.count() if enhanced else stream.byte()
            if copied == 0:
                return
            if not enhanced:
                raise BadImage("plain RLE knows no line copies", BMP_COMPRESSION)
            yield "previous line", copied, 0
        else:
            yield "literal", control, stream.pixels(control)
