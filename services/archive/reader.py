"""Reading a log: the file is mapped, its index parsed, and messages are views into the map.

Nothing is read that is not asked for: the poses of a long log touch only the chunks of small messages.
"""

from __future__ import annotations

import heapq
import mmap
import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

from isal import isal_zlib
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import get_chunk_data_stream

from endo3d.schemas import codec, topics
from endo3d.schemas.messages import Frame, Message
from endo3d.schemas.topics import Topic
from endo3d.services.archive import layout
from endo3d.services.archive.crop import Crop
from endo3d.services.archive.entry import COMPACT_IMAGE
from endo3d.services.archive.layout import ChunkIndex
from endo3d.services.runtime.errors import UserError

FOOTER = struct.Struct("<QQI")
FETCHED_BYTES = 2 << 20
"""Chunks up to this size, those of small messages, are fetched ahead."""
_TAIL_BYTES = layout.RECORD.size + FOOTER.size + len(layout.MAGIC)


class Unreadable(UserError):
    """This file can't be read as a log; the text says why and what to do."""


@dataclass(frozen=True, slots=True)
class Stream:
    """One channel of a log."""

    id: int
    name: str
    schema: str
    """The message's full name."""
    encoding: str
    topic: Topic | None
    """None for a channel this version doesn't know."""
    source: str
    """The service that wrote it, for topics written per service."""
    count: int
    crop: Crop | None
    """What was cut out of the camera's image."""


class Record(NamedTuple):
    """One message as it stands in the log."""

    stream: Stream
    sequence: int
    log_ns: int
    """When the recorder got it."""
    publish_ns: int
    """Its own stamp."""
    payload: memoryview

    def message(self) -> Message:
        """Decoded; arrays are views into the log, unless packed or cropped. Raises ``codec.Malformed``."""
        if self.stream.topic is None:
            raise Unreadable(f"channel {self.stream.name} ({self.stream.schema}) is unknown to this version")
        payload = self.payload
        if self.stream.schema == COMPACT_IMAGE.name:
            from endo3d.services.archive.compact import unpack  # its kernels take a second to load

            payload = unpack(payload)
        message = codec.decode(self.stream.topic, payload)
        if self.stream.crop is not None and isinstance(message, Frame):
            return self.stream.crop.restore(message)
        return message


class Log:
    """A finished MCAP file, open for reading; closes itself when the last view is gone."""

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self._mmap = _mapped(self.path)
        self._map = memoryview(self._mmap)
        summary_start = self._summary_start()
        self.chunks: list[ChunkIndex] = []
        self._attachment_indexes: list[AttachmentIndex] = []
        self._metadata_indexes: list[MetadataIndex] = []
        schemas: dict[int, Schema] = {}
        channels: list[Channel] = []
        counts: Mapping[int, int] = {}
        for opcode, body in _records(self._map, summary_start, len(self._map) - _TAIL_BYTES):
            match opcode:
                case layout.OP_CHUNK_INDEX:
                    self.chunks.append(ChunkIndex.unpack(body))
                case Opcode.SCHEMA:
                    schema = Schema.read(_stream(body))
                    schemas[schema.id] = schema
                case Opcode.CHANNEL:
                    channels.append(Channel.read(_stream(body)))
                case Opcode.STATISTICS:
                    counts = Statistics.read(_stream(body)).channel_message_counts
                case Opcode.ATTACHMENT_INDEX:
                    self._attachment_indexes.append(AttachmentIndex.read(_stream(body)))
                case Opcode.METADATA_INDEX:
                    self._metadata_indexes.append(MetadataIndex.read(_stream(body)))
        self.streams = {channel.id: _stream_of(channel, schemas, counts) for channel in channels}
        self.chunks.sort(key=lambda chunk: chunk.start_ns)
        self.start_ns = min((chunk.start_ns for chunk in self.chunks), default=0)
        self.end_ns = max((chunk.end_ns for chunk in self.chunks), default=0)

    @property
    def duration_s(self) -> float:
        return (self.end_ns - self.start_ns) * 1e-9

    @property
    def size(self) -> int:
        """Bytes of the file."""
        return len(self._map)

    def count(self, topic: Topic) -> int:
        """Messages of a topic."""
        return sum(stream.count for stream in self.streams.values() if stream.topic is topic)

    @cached_property
    def attachments(self) -> Mapping[str, bytes]:
        """The files kept in the log, by name."""
        found = {}
        for index in self._attachment_indexes:
            start = index.offset + layout.RECORD.size
            attachment = Attachment.read(_stream(self._map[start : index.offset + index.length]))
            found[attachment.name] = attachment.data
        return found

    @cached_property
    def facts(self) -> Mapping[str, Mapping[str, str]]:
        """The metadata records, by name: ``endo3d`` has versions and host."""
        found = {}
        for index in self._metadata_indexes:
            start = index.offset + layout.RECORD.size
            metadata = Metadata.read(_stream(self._map[start : index.offset + index.length]))
            found[metadata.name] = metadata.metadata
        return found

    def records(
        self,
        wanted: Collection[Topic] | None = None,
        *,
        start_ns: int = 0,
        end_ns: int = 1 << 63,
        check: bool = True,
    ) -> Iterator[Record]:
        """Messages as they arrived, ``start_ns <= log_ns < end_ns``; of all topics without ``wanted``.

        With ``check`` every chunk's CRC is verified. Raises ``Unreadable`` at a damaged chunk.
        """
        streams = {stream.id: stream for stream in self.streams.values() if wanted is None or stream.topic in wanted}
        chosen = [
            index
            for index in self.chunks
            if index.end_ns >= start_ns and index.start_ns < end_ns and index.index_offsets.keys() & streams
        ]
        self._fetch_ahead(chosen)
        waiting: list[tuple[int, int, Record]] = []
        count = 0
        for index in chosen:
            while waiting and waiting[0][0] < index.start_ns:
                yield heapq.heappop(waiting)[2]
            for record in self._in_chunk(index, streams, check):
                if start_ns <= record.log_ns < end_ns:
                    heapq.heappush(waiting, (record.log_ns, count, record))
                    count += 1
        while waiting:
            yield heapq.heappop(waiting)[2]

    def messages(
        self, *wanted: Topic, start_ns: int = 0, end_ns: int = 1 << 63, check: bool = True
    ) -> Iterator[Message]:
        """The same, decoded: ``for frame in log.messages(topics.FRAME)``."""
        for record in self.records(wanted or None, start_ns=start_ns, end_ns=end_ns, check=check):
            if record.stream.topic is not None:
                yield record.message()

    def _in_chunk(self, index: ChunkIndex, streams: Mapping[int, Stream], check: bool) -> Iterator[Record]:
        records = self._chunk_records(index, check)
        for channel in index.index_offsets.keys() & streams.keys():
            at = index.index_offsets[channel]
            try:
                entries = layout.index_entries(self._map, at)
                heads = [(offset, layout.MESSAGE.unpack_from(records, offset)) for _, offset in entries]
            except struct.error as error:
                raise self._damaged(at) from error
            for offset, (opcode, length, of_channel, sequence, log_ns, publish_ns) in heads:
                end = offset + layout.RECORD.size + length
                if opcode != layout.OP_MESSAGE or of_channel != channel or end > len(records):
                    raise self._damaged(at)
                payload = records[offset + layout.MESSAGE.size : end]
                yield Record(streams[channel], sequence, log_ns, publish_ns, payload)

    def _damaged(self, at: int) -> Unreadable:
        return Unreadable(f"{self.path} is damaged at byte {at}: endo3d recover {self.path}")

    def _fetch_ahead(self, chosen: Sequence[ChunkIndex]) -> None:
        """Have the kernel read small chunks all at once: one by one a disk's latency would add up."""
        for index in chosen:
            if index.length <= FETCHED_BYTES:
                start = index.offset // mmap.PAGESIZE * mmap.PAGESIZE
                length = index.offset - start + index.length + index.index_length
                self._mmap.madvise(mmap.MADV_WILLNEED, start, length)

    def _chunk_records(self, index: ChunkIndex, check: bool) -> memoryview:
        """A chunk's records: a view into the map, or decompressed in a foreign log."""
        if index.compression:
            body = self._map[index.offset + layout.RECORD.size : index.offset + index.length]
            stream, _ = get_chunk_data_stream(Chunk.read(_stream(body)), validate_crc=check)
            return memoryview(stream.read(index.size))
        records = self._map[index.records_offset : index.records_offset + index.size]
        expected = layout.CHUNK.unpack_from(self._map, index.offset)[5]
        if check and expected and isal_zlib.crc32(records) != expected:
            raise self._damaged(index.offset)
        return records

    def _summary_start(self) -> int:
        """Where the summary begins. Raises ``Unreadable``."""
        whole = len(self._map)
        if whole < _TAIL_BYTES or self._map[:8] != layout.MAGIC:
            raise Unreadable(f"{self.path} is not an MCAP log")
        if self._map[whole - 8 :] != layout.MAGIC:
            raise Unreadable(f"{self.path} was not closed (a crash?): endo3d recover {self.path}")
        start, _, crc = FOOTER.unpack_from(self._map, whole - _TAIL_BYTES + layout.RECORD.size)
        if not 0 < start <= whole - _TAIL_BYTES:
            raise Unreadable(f"{self.path} has no index: endo3d recover {self.path}")
        if crc and isal_zlib.crc32(self._map[start : whole - len(layout.MAGIC) - 4]) != crc:
            raise Unreadable(f"the index of {self.path} is damaged: endo3d recover {self.path}")
        return int(start)


def _mapped(path: Path) -> mmap.mmap:
    try:
        with path.open("rb") as file:
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except OSError as error:
        raise Unreadable(f"can't read {path}: {error.strerror}; check the path") from error
    except ValueError as error:
        raise Unreadable(f"{path} is empty") from error


def _records(view: memoryview, at: int, end: int) -> Iterator[tuple[int, memoryview]]:
    """(opcode, body) of the records between two offsets."""
    while at + layout.RECORD.size <= end:
        opcode, length = layout.RECORD.unpack_from(view, at)
        at += layout.RECORD.size
        yield opcode, view[at : at + length]
        at += length


def _stream(body: memoryview) -> ReadDataStream:
    return ReadDataStream(BytesIO(body))


def _stream_of(channel: Channel, schemas: Mapping[int, Schema], counts: Mapping[int, int]) -> Stream:
    topic, source = topic_of(channel.topic)
    schema = schemas[channel.schema_id].name if channel.schema_id in schemas else ""
    return Stream(
        id=channel.id,
        name=channel.topic,
        schema=schema,
        encoding=channel.message_encoding,
        topic=topic,
        source=source,
        count=counts.get(channel.id, 0),
        crop=Crop.from_metadata(channel.metadata),
    )


def topic_of(channel: str) -> tuple[Topic | None, str]:
    """A channel's topic and the service that wrote it: the inverse of ``Topic.channel``."""
    name = channel.removeprefix("/")
    if (topic := topics.BY_NAME.get(name)) is not None:
        return topic, ""
    name, _, source = name.rpartition("/")
    topic = topics.BY_NAME.get(name)
    return (topic, source) if topic is not None and topic.per_service else (None, "")
