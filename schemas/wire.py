"""The protobuf wire format, as far as an array inside a message needs it.

A message is a row of fields; each is a varint tag (number << 3 | type) and a payload. Cutting the big
``bytes`` field out as a view leaves a few hundred bytes for the protobuf library, and nothing is copied.

Reference: https://protobuf.dev/programming-guides/encoding
"""

from __future__ import annotations

from functools import lru_cache

DELIMITED = 2
"""Wire type of bytes with a length; 0 is a varint, 1 eight bytes, 5 four."""
PADDING = 101
"""Number of the field of zeros that puts the array at an aligned offset."""
MOST_FIELDS = 4096
"""Top-level fields a message may have: bounds the time that a malicious one can cost."""


class Malformed(ValueError):
    """These bytes are not such a message; the text says in one line what is wrong."""


def varint(value: int) -> bytes:
    """``value >= 0`` in groups of seven bits, the lowest first."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def read_varint(buffer: memoryview, at: int) -> tuple[int, int]:
    """The number that starts at ``at``, and where it ends."""
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(buffer):
            raise Malformed(f"a number is cut off at byte {at}")
        byte = buffer[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
    raise Malformed(f"a number before byte {at} is longer than ten bytes")


def span(buffer: memoryview, number: int) -> tuple[int, int, int]:
    """Where the length-delimited field ``number`` starts, where its payload starts, and where both end.

    Of a repeated field the last one counts, as the wire format wants it; an absent one is empty, at the end.
    Raises ``Malformed``.
    """
    size, at = len(buffer), 0
    found = (size, size, size)
    for _ in range(MOST_FIELDS):
        if at == size:
            return found
        start = at
        tag, at = read_varint(buffer, at)
        match tag & 7:
            case 2:
                length, at = read_varint(buffer, at)
                if tag >> 3 == number:
                    found = (start, at, at + length)
                at += length
            case 0:
                _, at = read_varint(buffer, at)
            case 5:
                at += 4
            case 1:
                at += 8
            case kind:
                raise Malformed(f"byte {start} starts no field: wire type {kind}")
        if at > size:
            raise Malformed(f"field {tag >> 3} ends at byte {at}, after the message's {size}")
    raise Malformed(f"more than {MOST_FIELDS} fields")


_PADDING_TAG = varint(PADDING << 3 | DELIMITED)
_PADDING_FRONT = len(_PADDING_TAG) + 2


@lru_cache(maxsize=64)
def field_front(number: int, length: int) -> bytes:
    """Tag and length of a length-delimited field."""
    return varint(number << 3 | DELIMITED) + varint(length)


def front(header: bytes, number: int, length: int, offset: int) -> bytes:
    """All that precedes an array of ``length`` bytes at ``offset``: header, padding, tag and length.

    Raises ``ValueError`` when the header is too long for that.
    """
    last = field_front(number, length)
    end = offset - len(last)
    zeros = end - len(header) - _PADDING_FRONT
    if zeros < 0:
        raise ValueError(f"a header of {len(header)} bytes is {-zeros} too long: shorten its texts")
    # The padding's length always takes two bytes, so that every gap can be filled.
    padding = _PADDING_TAG + bytes((zeros & 0x7F | 0x80, zeros >> 7))
    return (header + padding).ljust(end, b"\0") + last


def room(header: bytes, number: int, length: int, step: int) -> int:
    """The least multiple of ``step`` at which an array of ``length`` bytes can stand behind ``header``."""
    needed = len(header) + _PADDING_FRONT + len(field_front(number, length))
    return -(-needed // step) * step
