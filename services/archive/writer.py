"""One MCAP file, written without an intermediate copy of any large message.

The library's writer gathers messages into chunks of a fixed size, so an image is copied three times and
shares its chunk with the poses. Here a large message goes from the caller's memory to the file in one
``writev``, in a chunk of its own; small ones gather in chunks of theirs, so that poses read without touching
an image.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from endo3d.services.archive import layout
from endo3d.services.archive.layout import Buffer, ChunkIndex

OWN_CHUNK_BYTES = 1 << 16
"""A message of this size gets a chunk of its own."""
SMALL_CHUNK_BYTES = 1 << 20
"""Small messages are flushed at this size, whatever the time."""
DROP_BEHIND_BYTES = 32 << 20
"""Written pages go back to the kernel after this much: else it throttles the writer (360 for 2080 MB/s)."""


class Sink(Protocol):
    """Where the bytes go."""

    def write(self, *parts: Buffer) -> None:
        """All of them, in order. Raises ``OSError`` with part of them written."""

    def truncate(self, size: int) -> None:
        """Cut back to ``size`` bytes and go on from there."""

    def close(self) -> None: ...


class FileSink:
    """A file that keeps nothing in memory: ``writev`` in, drop-behind out."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
        self._since_drop = 0

    def write(self, *parts: Buffer) -> None:
        left = sum(len(part) for part in parts)
        self._since_drop += left
        while (written := os.writev(self._fd, parts)) < left:
            left -= written
            parts = _after(parts, written)
        if self._since_drop >= DROP_BEHIND_BYTES:
            self._since_drop = 0
            os.posix_fadvise(self._fd, 0, 0, os.POSIX_FADV_DONTNEED)

    def truncate(self, size: int) -> None:
        os.ftruncate(self._fd, size)
        os.lseek(self._fd, size, os.SEEK_SET)

    def close(self) -> None:
        os.close(self._fd)


def _after(parts: tuple[Buffer, ...], written: int) -> tuple[Buffer, ...]:
    """What is left of ``parts`` when their first bytes are written."""
    rest = list(parts)
    while rest and written >= len(rest[0]):
        written -= len(rest.pop(0))
    return (memoryview(rest[0])[written:], *rest[1:]) if rest else ()


@dataclass(frozen=True, slots=True)
class Kind:
    """How a channel's messages are encoded."""

    name: str
    encoding: str
    definition: bytes


class Writer:
    """One MCAP file. Not thread-safe; after an ``OSError``: ``abandon_tail``, then ``finish``."""

    def __init__(self, sink: Sink, library: str) -> None:
        self._sink = sink
        self.size = 0
        """Bytes of whole records in the file."""
        self.buffered = 0
        """Bytes of small messages that a kill would lose."""
        self._schemas: dict[Kind, Schema] = {}
        self._channels: dict[str, Channel] = {}
        self._chunks: list[bytes] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._counts: Counter[int] = Counter()
        self._start_ns, self._end_ns = 0, 0
        self._small: list[Buffer] = []
        self._small_entries: dict[int, list[tuple[int, int]]] = defaultdict(list)
        self._write(layout.MAGIC, _bytes(Header(profile="", library=library)))

    def channel(self, name: str, kind: Kind, metadata: Mapping[str, str] | None = None) -> int:
        """The id of a channel; its records are written when it is first asked for."""
        if (known := self._channels.get(name)) is not None:
            return known.id
        schema = self._schemas.get(kind)
        records = []
        if schema is None:
            schema = Schema(
                id=len(self._schemas) + 1, data=kind.definition, encoding=kind.encoding, name=kind.name
            )
            self._schemas[kind] = schema
            records.append(_bytes(schema))
        channel = Channel(
            id=len(self._channels) + 1,
            topic=name,
            message_encoding=kind.encoding,
            metadata=dict(metadata or {}),
            schema_id=schema.id,
        )
        self._channels[name] = channel
        self._write(*records, _bytes(channel))
        return channel.id

    def put(self, channel: int, sequence: int, log_ns: int, publish_ns: int, *payload: Buffer) -> None:
        """One message; ``payload`` is its bytes in one or several parts, free again on return."""
        size = sum(len(part) for part in payload)
        head = layout.message_head(channel, sequence, log_ns, publish_ns, size)
        self._start_ns = min(self._start_ns, log_ns) if self._counts else log_ns
        self._end_ns = max(self._end_ns, log_ns)
        if size >= OWN_CHUNK_BYTES:
            self._chunk((head, *payload), {channel: [(log_ns, 0)]})
        else:
            self._small_entries[channel].append((log_ns, self.buffered))
            self._small += head, *map(bytes, payload)
            self.buffered += len(head) + size
            if self.buffered >= SMALL_CHUNK_BYTES:
                self.flush()
        self._counts[channel] += 1

    def flush(self) -> None:
        """Write the small messages gathered so far, as one chunk."""
        if self.buffered:
            self._chunk((b"".join(self._small),), self._small_entries)
            self._small, self._small_entries, self.buffered = [], defaultdict(list), 0

    def attach(self, name: str, media_type: str, content: bytes, log_ns: int) -> None:
        """A file, byte for byte."""
        record = _bytes(
            Attachment(create_time=0, log_time=log_ns, name=name, media_type=media_type, data=content)
        )
        self._attachments.append(
            AttachmentIndex(
                offset=self.size,
                length=len(record),
                create_time=0,
                log_time=log_ns,
                data_size=len(content),
                name=name,
                media_type=media_type,
            )
        )
        self._write(record)

    def note(self, name: str, facts: Mapping[str, str]) -> None:
        """A metadata record."""
        record = _bytes(Metadata(name=name, metadata=dict(facts)))
        self._metadata.append(MetadataIndex(offset=self.size, length=len(record), name=name))
        self._write(record)

    def finish(self) -> None:
        """Flush, write the summary and close."""
        try:
            self.flush()
            end = _bytes(DataEnd(data_section_crc=0))
            self._write(end, *self._summary(self.size + len(end)), layout.MAGIC)
        finally:
            self._sink.close()

    def abandon_tail(self) -> None:
        """Cut the file back to its last whole record, and forget what was gathered since."""
        lost = {channel: len(entries) for channel, entries in self._small_entries.items()}
        self._counts.subtract(lost)
        self._small, self._small_entries, self.buffered = [], defaultdict(list), 0
        self._sink.truncate(self.size)

    def _chunk(self, records: tuple[Buffer, ...], entries: Mapping[int, list[tuple[int, int]]]) -> None:
        stamps = [stamp for channel in entries.values() for stamp, _ in channel]
        head = layout.chunk_around(records, min(stamps), max(stamps))
        size = sum(len(part) for part in records)
        indexes, at = {}, self.size + len(head) + size
        tail = []
        for channel, items in entries.items():
            indexes[channel] = at
            tail.append(layout.message_index(channel, items))
            at += len(tail[-1])
        index_size = sum(map(len, tail))
        index = ChunkIndex(
            min(stamps), max(stamps), self.size, len(head) + size, indexes, index_size, "", size, size
        )
        self._write(head, *records, *tail)
        self._chunks.append(index.pack())

    def _summary(self, start: int) -> tuple[bytes, ...]:
        statistics = Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._chunks),
            message_count=self._counts.total(),
            message_end_time=self._end_ns,
            message_start_time=self._start_ns,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        groups = (
            (Opcode.SCHEMA, b"".join(map(_bytes, self._schemas.values()))),
            (Opcode.CHANNEL, b"".join(map(_bytes, self._channels.values()))),
            (Opcode.STATISTICS, _bytes(statistics)),
            (Opcode.CHUNK_INDEX, b"".join(self._chunks)),
            (Opcode.ATTACHMENT_INDEX, b"".join(map(_bytes, self._attachments))),
            (Opcode.METADATA_INDEX, b"".join(map(_bytes, self._metadata))),
        )
        offsets, at = [], start
        for opcode, records in groups:
            if records:
                offset = SummaryOffset(group_opcode=opcode, group_start=at, group_length=len(records))
                offsets.append(_bytes(offset))
            at += len(records)
        body = b"".join([*(records for _, records in groups), *offsets])
        crc = zlib.crc32(struct.pack("<BQQQ", Opcode.FOOTER, 20, start, at), zlib.crc32(body))
        footer = Footer(summary_start=start, summary_offset_start=at, summary_crc=crc)
        return body, _bytes(footer)

    def _write(self, *parts: Buffer) -> None:
        self._sink.write(*parts)
        self.size += sum(len(part) for part in parts)


def _bytes(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()
