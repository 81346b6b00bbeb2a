"""MCAP records as bytes, for the few that are written or read per message.

Everything that occurs once in a file is written by ``mcap.records``; here is only what the library would
copy, the chunk around one large message, and the indexes that a long log has thousands of.
Layout: https://mcap.dev/spec, little-endian throughout.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from isal import isal_zlib

MAGIC = b"\x89MCAP0\r\n"

RECORD = struct.Struct("<BQ")
"""Opcode, length of what follows."""
MESSAGE = struct.Struct("<BQHIQQ")
"""Opcode, length, channel, sequence, log time, publish time; the payload follows."""
CHUNK = struct.Struct("<BQQQQIIQ")
"""Opcode, length, start, end, uncompressed size, CRC, length of the compression's name (0), size."""
MESSAGE_INDEX = struct.Struct("<BQHI")
"""Opcode, length, channel, bytes of the entries that follow: (log time, offset within the records)."""
INDEX_ENTRY = struct.Struct("<QQ")
CHUNK_INDEX = struct.Struct("<QQQQI")
"""Start, end, offset of the chunk, its length, bytes of the map that follows; after the opcode and length."""
CHANNEL_OFFSET = struct.Struct("<HQ")
CHUNK_INDEX_TAIL = struct.Struct("<QI")
"""Length of the message indexes, length of the compression's name; the name and two sizes follow."""

OP_MESSAGE, OP_CHUNK, OP_MESSAGE_INDEX, OP_CHUNK_INDEX = 0x05, 0x06, 0x07, 0x08

Buffer = bytes | bytearray | memoryview


class ChunkIndex(NamedTuple):
    """Where a chunk is and which channels it holds."""

    start_ns: int
    end_ns: int
    offset: int
    length: int
    index_offsets: dict[int, int]
    """Channel -> offset of its message index in the file."""
    index_length: int
    compression: str
    compressed_size: int
    size: int

    @property
    def records_offset(self) -> int:
        """Where the chunk's records begin in the file."""
        return self.offset + CHUNK.size + len(self.compression)

    def pack(self) -> bytes:
        channels = b"".join(CHANNEL_OFFSET.pack(*item) for item in self.index_offsets.items())
        name = self.compression.encode()
        body = (
            CHUNK_INDEX.pack(self.start_ns, self.end_ns, self.offset, self.length, len(channels))
            + channels
            + CHUNK_INDEX_TAIL.pack(self.index_length, len(name))
            + name
            + INDEX_ENTRY.pack(self.compressed_size, self.size)
        )
        return RECORD.pack(OP_CHUNK_INDEX, len(body)) + body

    @classmethod
    def unpack(cls, body: memoryview) -> ChunkIndex:
        """From a record's body, after opcode and length. Raises ``struct.error`` on a short one."""
        start, end, offset, length, channel_bytes = CHUNK_INDEX.unpack_from(body)
        at = CHUNK_INDEX.size + channel_bytes
        channels = dict(CHANNEL_OFFSET.iter_unpack(body[CHUNK_INDEX.size : at]))
        index_length, name_length = CHUNK_INDEX_TAIL.unpack_from(body, at)
        at += CHUNK_INDEX_TAIL.size
        name = str(body[at : at + name_length], "utf-8")
        sizes = INDEX_ENTRY.unpack_from(body, at + name_length)
        return cls(start, end, offset, length, channels, index_length, name, *sizes)


def message_head(channel: int, sequence: int, log_ns: int, publish_ns: int, size: int) -> bytes:
    """What stands before a payload of ``size`` bytes."""
    return MESSAGE.pack(
        OP_MESSAGE, MESSAGE.size - RECORD.size + size, channel, sequence & 0xFFFFFFFF, log_ns, publish_ns
    )


def message_indexes(entries: Mapping[int, Sequence[tuple[int, int]]], at: int) -> tuple[bytes, dict[int, int]]:
    """The message indexes of a chunk, to stand at offset ``at``, and where each channel's begins.

    entries: channel -> (log time, offset within the records) of its messages.
    """
    out, offsets = bytearray(), {}
    for channel, items in entries.items():
        offsets[channel] = at + len(out)
        size = INDEX_ENTRY.size * len(items)
        out += MESSAGE_INDEX.pack(OP_MESSAGE_INDEX, MESSAGE_INDEX.size - RECORD.size + size, channel, size)
        for item in items:
            out += INDEX_ENTRY.pack(*item)
    return bytes(out), offsets


def index_entries(view: memoryview, at: int) -> list[tuple[int, int]]:
    """The entries (log time, offset) of the message index at offset ``at``. Raises ``struct.error``."""
    _, _, _, size = MESSAGE_INDEX.unpack_from(view, at)
    start = at + MESSAGE_INDEX.size
    return list(INDEX_ENTRY.iter_unpack(view[start : start + size]))


def chunk_around(records: Sequence[Buffer], start_ns: int, end_ns: int) -> bytes:
    """What stands before the records of an uncompressed chunk, their CRC included."""
    size = sum(len(part) for part in records)
    length = CHUNK.size - RECORD.size + size
    return CHUNK.pack(OP_CHUNK, length, start_ns, end_ns, size, crc32(records), 0, size)


def crc32(parts: Iterable[Buffer]) -> int:
    """By ISA-L: the same as zlib's, ten times as fast, and every byte of a recording passes here."""
    value = 0
    for part in parts:
        value = isal_zlib.crc32(part, value)
    return value
