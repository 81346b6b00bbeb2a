"""Walks through a log without its index: what a crash left whole, and where it stops."""

from __future__ import annotations

import struct
from collections import defaultdict
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from typing import NamedTuple

from isal import isal_zlib
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata, Schema
from mcap.stream_reader import get_chunk_data_stream

from endo3d.services.archive import layout

TORN = "torn here"
"""The damage that ends a file whose writer was killed."""

Plain = Schema | Channel | Attachment | Metadata


class Found(NamedTuple):
    """A record of the data section that is no chunk."""

    offset: int
    length: int
    record: Plain

    @property
    def end(self) -> int:
        return self.offset + self.length


@dataclass(slots=True)
class FoundChunk:
    """A chunk whose CRC is right."""

    offset: int
    length: int
    start_ns: int
    end_ns: int
    compression: str
    compressed_size: int
    records: memoryview
    """Uncompressed."""
    entries: dict[int, list[tuple[int, int]]]
    """Channel -> (log time, offset within the records), as the chunk itself says."""
    definitions: list[Schema | Channel]
    """Those inside the chunk, where other writers put them."""
    index_offsets: dict[int, int] = field(default_factory=dict)
    """Channel -> where its message index follows in the file."""
    index_length: int = 0

    @property
    def indexed(self) -> bool:
        return self.index_offsets.keys() == self.entries.keys()

    @property
    def end(self) -> int:
        """Offset behind the chunk and its message indexes."""
        return self.offset + self.length + self.index_length


@dataclass(frozen=True, slots=True)
class Damage:
    """Something that can't be used."""

    offset: int
    why: str


def walk(view: memoryview) -> Iterator[Found | FoundChunk | Damage]:
    """The data section's records in order; ends at its end, or at a tear (a last ``Damage``).

    A chunk is yielded when its message indexes have been seen, complete or not. Messages outside of chunks,
    which this program never writes, count as damage.
    """
    at = len(layout.MAGIC)
    if bytes(view[:at]) != layout.MAGIC:
        yield Damage(0, "not an MCAP log")
        return
    chunk: FoundChunk | None = None
    while at + layout.RECORD.size <= len(view):
        opcode, length = layout.RECORD.unpack_from(view, at)
        body_at, end = at + layout.RECORD.size, at + layout.RECORD.size + length
        if opcode == Opcode.MESSAGE_INDEX and chunk is not None and end <= len(view):
            _note_index(chunk, view, at)
            chunk.index_length = end - chunk.offset - chunk.length
            at = end
            continue
        if chunk is not None:
            yield chunk
            chunk = None
        if opcode == Opcode.DATA_END:
            return
        if not _KNOWN_FIRST <= opcode <= _KNOWN_LAST or end > len(view):
            yield Damage(at, TORN)
            return
        found = _read(view, at, opcode, body_at, end)
        if isinstance(found, FoundChunk):
            chunk = found
        elif found is not None:
            yield found
        at = end
    if chunk is not None:
        yield chunk
    yield Damage(at, TORN)


_KNOWN_FIRST, _KNOWN_LAST = int(Opcode.HEADER), int(Opcode.DATA_END)


def _read(view: memoryview, at: int, opcode: int, body_at: int, end: int) -> Found | FoundChunk | Damage | None:
    body = view[body_at:end]
    try:
        match opcode:
            case Opcode.CHUNK:
                return _chunk(body, at, end - at)
            case Opcode.SCHEMA:
                return Found(at, end - at, Schema.read(_stream(body)))
            case Opcode.CHANNEL:
                return Found(at, end - at, Channel.read(_stream(body)))
            case Opcode.ATTACHMENT:
                return Found(at, end - at, Attachment.read(_stream(body)))
            case Opcode.METADATA:
                return Found(at, end - at, Metadata.read(_stream(body)))
            case Opcode.MESSAGE:
                return Damage(at, "a message outside of a chunk")
    except (McapError, ValueError, struct.error) as error:
        return Damage(at, f"unreadable: {error}")
    return None


def _note_index(chunk: FoundChunk, view: memoryview, at: int) -> None:
    """Take a message index, unless it says something else than the chunk."""
    with suppress(struct.error):
        _, _, channel, _ = layout.MESSAGE_INDEX.unpack_from(view, at)
        if layout.index_entries(view, at) == chunk.entries.get(channel):
            chunk.index_offsets[channel] = at


def _chunk(body: memoryview, at: int, length: int) -> FoundChunk | Damage:
    start_ns, end_ns, size, crc, name_length = struct.unpack_from("<QQQII", body)
    name = str(body[32 : 32 + name_length], "utf-8")
    records = body[32 + name_length + 8 :]
    compressed_size = len(records)
    if name:
        stream, _ = get_chunk_data_stream(Chunk.read(_stream(body)), validate_crc=True)
        records = memoryview(stream.read(size))
    elif crc and isal_zlib.crc32(records) != crc:
        return Damage(at, "a chunk's CRC is wrong")
    entries: dict[int, list[tuple[int, int]]] = defaultdict(list)
    definitions: list[Schema | Channel] = []
    offset = 0
    while offset < len(records):
        opcode, message_length = layout.RECORD.unpack_from(records, offset)
        after = offset + layout.RECORD.size + message_length
        if opcode == Opcode.MESSAGE:
            _, _, channel, _, log_ns, _ = layout.MESSAGE.unpack_from(records, offset)
            entries[channel].append((log_ns, offset))
        elif opcode == Opcode.SCHEMA:
            definitions.append(Schema.read(_stream(records[offset + layout.RECORD.size : after])))
        elif opcode == Opcode.CHANNEL:
            definitions.append(Channel.read(_stream(records[offset + layout.RECORD.size : after])))
        offset = after
    return FoundChunk(at, length, start_ns, end_ns, name, compressed_size, records, dict(entries), definitions)


def _stream(body: memoryview) -> ReadDataStream:
    return ReadDataStream(BytesIO(body))
