"""Repairs a log that a crash tore: what is whole in it is kept, and gets an index.

A log that only lacks its end is repaired in place: the torn tail is cut off and the summary is written behind
the last whole chunk. A log with damage further in is written anew without the damaged chunks; the damaged
file stays beside it.
"""

from __future__ import annotations

import fcntl
import mmap
import os
from dataclasses import dataclass
from pathlib import Path

from mcap.records import Attachment, AttachmentIndex, Channel, Metadata, MetadataIndex, Schema

from endo3d.services.archive import layout
from endo3d.services.archive.facts import LIBRARY
from endo3d.services.archive.layout import ChunkIndex
from endo3d.services.archive.reader import Log, Unreadable
from endo3d.services.archive.scan import TORN, Damage, Found, FoundChunk, walk
from endo3d.services.archive.sink import FileSink
from endo3d.services.archive.summary import Summary
from endo3d.services.archive.writer import Kind, Writer


@dataclass(frozen=True, slots=True)
class Report:
    """What was done."""

    path: Path
    messages: int
    chunks: int
    lost_bytes: int
    """Of torn and damaged records."""
    damages: tuple[Damage, ...]
    damaged_copy: Path | None
    """Where the damaged file is, when the log had to be written anew."""
    was_whole: bool
    """There was nothing to do."""


def is_whole(path: Path) -> bool:
    """Whether a log has its index."""
    try:
        Log(path)
    except Unreadable:
        return False
    return True


def recover(path: Path, out: Path | None = None) -> Report:
    """Repair ``path``, or leave it alone and write what is whole in it to ``out``.

    Raises ``Unreadable`` for a file that is missing, no log, being recorded, or without one whole chunk.
    """
    try:
        file = path.open("r+b" if out is None else "rb")
    except OSError as error:
        raise Unreadable(f"can't open {path}: {error.strerror}") from error
    with file:
        _lock(file.fileno(), path)
        view = _mapped(file.fileno(), path)
        inventory = _inventory(view, path)
        if out is None and not inventory.damages and not inventory.unindexed and is_whole(path):
            return inventory.report(path, 0, was_whole=True)
        if out is None and inventory.repairable:
            _append_summary(file.fileno(), inventory)
            return inventory.report(path, len(view) - inventory.end)
        try:
            return _write_anew(view, path, out, inventory)
        except OSError:  # a full disk: what was begun is of no use
            _anew(path, out).unlink(missing_ok=True)
            raise


@dataclass(slots=True)
class _Inventory:
    """What a log holds that is whole."""

    summary: Summary
    damages: list[Damage]
    end: int = len(layout.MAGIC)
    """Behind the last whole record."""
    last: FoundChunk | None = None
    unindexed: int = 0
    """Chunks whose message indexes are missing or torn."""
    whole_bytes: int = len(layout.MAGIC)

    @property
    def repairable(self) -> bool:
        """Whether only the end is missing: at most one tear, and at most the last chunk lacks its indexes."""
        if any(damage.why != TORN for damage in self.damages):
            return False
        last_lacks = self.last is not None and not self.last.indexed and self.last.end == self.end
        return self.unindexed == int(last_lacks)

    def report(self, path: Path, lost_bytes: int, *, was_whole: bool = False) -> Report:
        summary = self.summary
        return Report(path, summary.messages, summary.chunks, lost_bytes, tuple(self.damages), None, was_whole)


def _inventory(view: memoryview, path: Path) -> _Inventory:
    inventory = _Inventory(Summary(), [])
    for item in walk(view):
        match item:
            case Damage():
                inventory.damages.append(item)
                continue
            case FoundChunk():
                _count_chunk(item, inventory)
            case Found():
                _count_record(item, inventory.summary)
        inventory.end = item.end
        inventory.whole_bytes += item.end - item.offset
    if inventory.damages and inventory.damages[0].offset == 0:
        raise Unreadable(f"{path} is not an MCAP log")
    if not inventory.summary.chunks:
        raise Unreadable(f"{path} has no whole message in it to recover")
    return inventory


def _count_chunk(chunk: FoundChunk, inventory: _Inventory) -> None:
    inventory.last = chunk
    inventory.unindexed += not chunk.indexed
    for definition in chunk.definitions:
        _count_record(Found(chunk.offset, chunk.length, definition), inventory.summary)
    index_offsets, index_length = chunk.index_offsets, chunk.index_length
    if not chunk.indexed:
        tail, index_offsets = layout.message_indexes(chunk.entries, chunk.offset + chunk.length)
        index_length = len(tail)
    inventory.summary.add_chunk(
        ChunkIndex(
            start_ns=chunk.start_ns,
            end_ns=chunk.end_ns,
            offset=chunk.offset,
            length=chunk.length,
            index_offsets=index_offsets,
            index_length=index_length,
            compression=chunk.compression,
            compressed_size=chunk.compressed_size,
            size=len(chunk.records),
        ),
        chunk.entries,
    )


def _count_record(found: Found, summary: Summary) -> None:
    match found.record:
        case Schema() as schema if schema not in summary.schemas:
            summary.schemas.append(schema)
        case Channel() as channel if channel not in summary.channels:
            summary.channels.append(channel)
        case Attachment() as kept:
            summary.attachments.append(
                AttachmentIndex(
                    offset=found.offset,
                    length=found.length,
                    create_time=kept.create_time,
                    log_time=kept.log_time,
                    data_size=len(kept.data),
                    name=kept.name,
                    media_type=kept.media_type,
                )
            )
        case Metadata() as noted:
            summary.metadata.append(MetadataIndex(offset=found.offset, length=found.length, name=noted.name))


def _append_summary(descriptor: int, inventory: _Inventory) -> None:
    """Cut the torn tail off and write what the end lacks. Killed meanwhile, the log is as torn as before."""
    end, missing = inventory.end, b""
    if (last := inventory.last) is not None and not last.indexed:
        end = last.offset + last.length
        missing, _ = layout.message_indexes(last.entries, end)
    os.ftruncate(descriptor, end)
    os.lseek(descriptor, end, os.SEEK_SET)
    os.write(descriptor, missing + inventory.summary.pack(end + len(missing)))
    os.fsync(descriptor)


def _anew(path: Path, out: Path | None) -> Path:
    return out or path.with_suffix(".recovering")


def _write_anew(view: memoryview, path: Path, out: Path | None, inventory: _Inventory) -> Report:
    """Write what is whole into ``out``, or in place of ``path``, which stays as ``.damaged``."""
    target = _anew(path, out)
    writer = Writer(FileSink(target), LIBRARY)
    kinds: dict[int, Kind] = {}
    channels: dict[int, int] = {}
    for item in walk(view):
        definitions = item.definitions if isinstance(item, FoundChunk) else [getattr(item, "record", None)]
        for definition in definitions:
            match definition:
                case Schema():
                    kinds[definition.id] = Kind(definition.name, definition.encoding, definition.data)
                case Channel():
                    kind = kinds.get(definition.schema_id, Kind("", definition.message_encoding, b""))
                    channel = writer.channel(definition.topic, kind, definition.metadata)
                    channels[definition.id] = channel
                case Attachment():
                    writer.attach(definition.name, definition.media_type, definition.data, definition.log_time)
                case Metadata():
                    writer.note(definition.name, definition.metadata)
        if isinstance(item, FoundChunk):
            _copy_messages(item, channels, writer)
    writer.finish()
    damaged_copy = None
    if out is None:
        damaged_copy = path.with_suffix(f".damaged{path.suffix}")
        path.replace(damaged_copy)
        target.replace(path)
    summary = inventory.summary
    lost = len(view) - inventory.whole_bytes
    return Report(out or path, summary.messages, summary.chunks, lost, tuple(inventory.damages), damaged_copy, False)


def _copy_messages(chunk: FoundChunk, channels: dict[int, int], writer: Writer) -> None:
    placed = sorted((offset, channel) for channel, items in chunk.entries.items() for _, offset in items)
    for offset, channel in placed:
        _, length, _, sequence, log_ns, publish_ns = layout.MESSAGE.unpack_from(chunk.records, offset)
        end = offset + layout.RECORD.size + length
        payload = chunk.records[offset + layout.MESSAGE.size : end]
        writer.put(channels[channel], sequence, log_ns, publish_ns, payload)


def _lock(descriptor: int, path: Path) -> None:
    """Raises ``Unreadable`` while a recorder has the file."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise Unreadable(f"{path} is being recorded; stop the recorder first") from None


def _mapped(descriptor: int, path: Path) -> memoryview:
    if os.fstat(descriptor).st_size <= len(layout.MAGIC):
        raise Unreadable(f"{path} has nothing in it to recover")
    return memoryview(mmap.mmap(descriptor, 0, access=mmap.ACCESS_READ))
