"""One MCAP file, written without an intermediate copy of any large message.

The library's writer gathers messages into chunks of a fixed size, so an image is copied three times and
shares its chunk with the poses. Here a large message goes from the caller's memory to the file in one
``writev``, in a chunk of its own; small ones gather in chunks of theirs, so that poses read without touching
an image.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from typing import NamedTuple

from mcap.records import Attachment, AttachmentIndex, Channel, Header, Metadata, MetadataIndex, Schema

from endo3d.services.archive import layout
from endo3d.services.archive.layout import Buffer, ChunkIndex
from endo3d.services.archive.sink import Sink
from endo3d.services.archive.summary import Entries, Summary, record_bytes

OWN_CHUNK_BYTES = 1 << 16
"""A message of this size gets a chunk of its own."""
SMALL_CHUNK_BYTES = 1 << 20
"""Small messages are flushed at this size, whatever the time."""


class Kind(NamedTuple):
    """How a channel's messages are encoded."""

    name: str
    encoding: str
    definition: bytes


class Writer:
    """One MCAP file. Not thread-safe.

    After an ``OSError``: ``abandon_tail``, then ``finish``; ``leave_torn`` when that fails as well.
    """

    def __init__(self, sink: Sink, library: str) -> None:
        self._sink = sink
        self.size = 0
        """Bytes of whole records in the file."""
        self.buffered = 0
        """Bytes of small messages that a kill would lose."""
        self._summary = Summary()
        self._schemas: dict[Kind, Schema] = {}
        self._channels: dict[str, Channel] = {}
        self._small: list[Buffer] = []
        self._small_entries: dict[int, list[tuple[int, int]]] = defaultdict(list)
        self._write(layout.MAGIC, record_bytes(Header(profile="", library=library)))

    def channel(self, name: str, kind: Kind, metadata: Mapping[str, str] | None = None) -> int:
        """The id of a channel; its records are written when it is first asked for."""
        if (known := self._channels.get(name)) is not None:
            return known.id
        records = []
        if (schema := self._schemas.get(kind)) is None:
            number = len(self._schemas) + 1
            schema = Schema(id=number, data=kind.definition, encoding=kind.encoding, name=kind.name)
            records.append(record_bytes(schema))
        channel = Channel(
            id=len(self._channels) + 1,
            topic=name,
            message_encoding=kind.encoding,
            metadata=dict(metadata or {}),
            schema_id=schema.id,
        )
        self._write(*records, record_bytes(channel))
        if records:
            self._schemas[kind] = schema
            self._summary.schemas.append(schema)
        self._channels[name] = channel
        self._summary.channels.append(channel)
        return channel.id

    def put(self, channel: int, sequence: int, log_ns: int, publish_ns: int, *payload: Buffer) -> None:
        """One message; ``payload`` is its bytes in one or several parts, free again on return."""
        size = sum(len(part) for part in payload)
        head = layout.message_head(channel, sequence, log_ns, publish_ns, size)
        if size >= OWN_CHUNK_BYTES:
            self._chunk((head, *payload), {channel: [(log_ns, 0)]})
            return
        if self.buffered + size >= SMALL_CHUNK_BYTES:
            self.flush()
        self._small_entries[channel].append((log_ns, self.buffered))
        self._small += head, *map(bytes, payload)
        self.buffered += len(head) + size

    def flush(self) -> None:
        """Write the small messages gathered so far, as one chunk."""
        if self.buffered:
            self._chunk((b"".join(self._small),), self._small_entries)
            self._forget_small()

    def attach(self, name: str, media_type: str, content: bytes, log_ns: int) -> None:
        """A file, byte for byte."""
        record = record_bytes(
            Attachment(create_time=0, log_time=log_ns, name=name, media_type=media_type, data=content)
        )
        index = AttachmentIndex(
            offset=self.size,
            length=len(record),
            create_time=0,
            log_time=log_ns,
            data_size=len(content),
            name=name,
            media_type=media_type,
        )
        self._write(record)
        self._summary.attachments.append(index)

    def note(self, name: str, facts: Mapping[str, str]) -> None:
        """A metadata record."""
        record = record_bytes(Metadata(name=name, metadata=dict(facts)))
        index = MetadataIndex(offset=self.size, length=len(record), name=name)
        self._write(record)
        self._summary.metadata.append(index)

    def finish(self) -> None:
        """Flush, write the summary and close."""
        self.flush()
        self._write(self._summary.pack(self.size))
        self._sink.close()

    def leave_torn(self) -> None:
        """Close without an index: the disk takes nothing more."""
        self._sink.close()

    def abandon_tail(self) -> Mapping[str, int]:
        """Cut the file back to its last whole record; returns the small messages lost, per channel."""
        names = {channel.id: name for name, channel in self._channels.items()}
        lost = {names[channel]: len(items) for channel, items in self._small_entries.items()}
        self._forget_small()
        self._sink.truncate(self.size)
        return lost

    def _chunk(self, records: tuple[Buffer, ...], entries: Entries) -> None:
        stamps = [stamp for items in entries.values() for stamp, _ in items]
        head = layout.chunk_around(records, min(stamps), max(stamps))
        size = sum(len(part) for part in records)
        tail, offsets = layout.message_indexes(entries, self.size + len(head) + size)
        index = ChunkIndex(
            start_ns=min(stamps),
            end_ns=max(stamps),
            offset=self.size,
            length=len(head) + size,
            index_offsets=offsets,
            index_length=len(tail),
            compression="",
            compressed_size=size,
            size=size,
        )
        self._write(head, *records, tail)
        self._summary.add_chunk(index, entries)

    def _forget_small(self) -> None:
        self._small, self._small_entries, self.buffered = [], defaultdict(list), 0

    def _write(self, *parts: Buffer) -> None:
        self._sink.write(*parts)
        self.size += sum(len(part) for part in parts)
