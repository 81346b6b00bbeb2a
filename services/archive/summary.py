"""What stands at the end of a log, so that a reader finds everything without reading it all."""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Mapping, Sequence

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    DataEnd,
    Footer,
    McapRecord,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from endo3d.services.archive.layout import MAGIC, ChunkIndex

Entries = Mapping[int, Sequence[tuple[int, int]]]
"""Channel -> (log time, offset within the chunk's records) of its messages."""


class Summary:
    """Grows with the file; ``pack`` makes the bytes that end it."""

    def __init__(self) -> None:
        self.schemas: list[Schema] = []
        self.channels: list[Channel] = []
        self.attachments: list[AttachmentIndex] = []
        self.metadata: list[MetadataIndex] = []
        self._chunks: list[bytes] = []
        self._counts: Counter[int] = Counter()
        self._start_ns, self._end_ns = 1 << 64, 0

    @property
    def messages(self) -> int:
        return self._counts.total()

    @property
    def chunks(self) -> int:
        return len(self._chunks)

    def add_chunk(self, index: ChunkIndex, entries: Entries) -> None:
        """A chunk that is whole in the file."""
        self._chunks.append(index.pack())
        self._counts.update({channel: len(items) for channel, items in entries.items()})
        self._start_ns = min(self._start_ns, index.start_ns)
        self._end_ns = max(self._end_ns, index.end_ns)

    def pack(self, at: int) -> bytes:
        """Everything from the end of the data section, which is at offset ``at``, to the end of the file."""
        end = record_bytes(DataEnd(data_section_crc=0))
        start = at = at + len(end)
        groups = (
            (Opcode.SCHEMA, b"".join(map(record_bytes, self.schemas))),
            (Opcode.CHANNEL, b"".join(map(record_bytes, self.channels))),
            (Opcode.STATISTICS, record_bytes(self._statistics())),
            (Opcode.CHUNK_INDEX, b"".join(self._chunks)),
            (Opcode.ATTACHMENT_INDEX, b"".join(map(record_bytes, self.attachments))),
            (Opcode.METADATA_INDEX, b"".join(map(record_bytes, self.metadata))),
        )
        offsets = []
        for opcode, records in groups:
            if records:
                offset = SummaryOffset(group_opcode=opcode, group_start=at, group_length=len(records))
                offsets.append(record_bytes(offset))
            at += len(records)
        body = b"".join([*(records for _, records in groups), *offsets])
        crc = zlib.crc32(struct.pack("<BQQQ", Opcode.FOOTER, 20, start, at), zlib.crc32(body))
        footer = Footer(summary_start=start, summary_offset_start=at, summary_crc=crc)
        return b"".join((end, body, record_bytes(footer), MAGIC))

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self.attachments),
            channel_count=len(self.channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._chunks),
            message_count=self.messages,
            message_end_time=self._end_ns,
            message_start_time=self._start_ns if self._chunks else 0,
            metadata_count=len(self.metadata),
            schema_count=len(self.schemas),
        )


def record_bytes(record: McapRecord) -> bytes:
    """A record as the library writes it."""
    builder = RecordBuilder()
    record.write(builder)
    encoded: bytes = builder.end()  # type: ignore[no-untyped-call]  # the library leaves it untyped
    return encoded
