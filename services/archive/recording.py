"""A recording: one log file, or several that each stand alone."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from endo3d.services.archive.entry import Attachment, Entry
from endo3d.services.archive.facts import LIBRARY
from endo3d.services.archive.sink import Sink, file_sink
from endo3d.services.archive.writer import Writer

NS_PER_S = 1_000_000_000


class Recording:
    """Splits by size or time; every part repeats facts, attachments and the last latched messages.

    Not thread-safe. After an ``OSError`` of ``put`` or ``flush``: ``abandon_tail``, then ``finish``.
    """

    def __init__(
        self,
        path: Path,
        facts: Mapping[str, str],
        attachments: Iterable[Attachment] = (),
        *,
        split_bytes: int = 0,
        split_s: float = 0.0,
        open_sink: Callable[[Path], Sink] = file_sink,
    ) -> None:
        self.path = path
        self._facts = dict(facts)
        self._split_bytes = split_bytes or 1 << 62
        self._split_ns = round(split_s * NS_PER_S) or 1 << 62
        self._numbered = bool(split_bytes or split_s)
        self._open_sink = open_sink
        self._attachments = {attachment.name: attachment for attachment in attachments}
        self._latched: dict[str, Entry] = {}
        self._writer: Writer | None = None
        self._part_start_ns = 0
        self._finished_bytes = 0
        self.parts: list[Path] = []
        self.messages = 0

    @property
    def size(self) -> int:
        """Bytes in all parts so far."""
        return self._finished_bytes + (self._writer.size if self._writer else 0)

    def put(self, entry: Entry) -> None:
        """One message, in the part it belongs to."""
        writer = self._part_for(entry)
        if entry.attachment is not None and entry.attachment != self._attachments.get(entry.attachment.name):
            self._attachments[entry.attachment.name] = entry.attachment
            _attach(writer, entry.attachment, entry.log_ns)
        _write(writer, entry)
        self.messages += 1
        if entry.latched:
            self._latched[entry.channel] = replace(entry, payload=(b"".join(entry.payload),))

    def flush(self) -> None:
        """Small messages gathered so far reach the file."""
        if self._writer is not None:
            self._writer.flush()

    def finish(self) -> None:
        """Close the open part; a recording without any message leaves no file."""
        if (writer := self._writer) is not None:
            writer.finish()
            self._writer = None
            self._finished_bytes += writer.size

    def leave_torn(self) -> None:
        """Close the open part without its index, when even that can't be written."""
        if (writer := self._writer) is not None:
            self._writer = None
            writer.leave_torn()

    def abandon_tail(self) -> Mapping[str, int]:
        """After a failed write: cut the torn record off; returns the small messages lost, per channel."""
        return self._writer.abandon_tail() if self._writer is not None else {}

    def _part_for(self, entry: Entry) -> Writer:
        writer = self._writer
        if writer is not None:
            size = writer.size + writer.buffered + sum(map(len, entry.payload))
            if size <= self._split_bytes and entry.log_ns - self._part_start_ns < self._split_ns:
                return writer
            self.finish()
        path = self._unused_path()
        path.parent.mkdir(parents=True, exist_ok=True)
        with ExitStack() as undo:
            undo.callback(path.unlink, missing_ok=True)
            sink = self._open_sink(path)
            undo.callback(sink.close)
            self._writer = writer = Writer(sink, LIBRARY)
            undo.pop_all()
        self.parts.append(path)
        self._part_start_ns = entry.log_ns
        writer.note("endo3d", self._facts | {"part": str(len(self.parts) - 1)})
        for attachment in self._attachments.values():
            _attach(writer, attachment, entry.log_ns)
        for latched in self._latched.values():
            _write(writer, replace(latched, log_ns=entry.log_ns))
        return writer

    def _unused_path(self) -> Path:
        """The next part's; never that of an existing log, which may be waiting to be recovered."""
        stem, suffix = self.path.stem, self.path.suffix
        if self._numbered:
            stem = f"{stem}_{len(self.parts):03d}"
        path = self.path.with_name(stem + suffix)
        again = 1
        while path.exists():
            again += 1
            path = self.path.with_name(f"{stem}-{again}{suffix}")
        return path


def _write(writer: Writer, entry: Entry) -> None:
    channel = writer.channel(entry.channel, entry.kind, entry.metadata)
    writer.put(channel, entry.sequence, entry.log_ns, entry.publish_ns, *entry.payload)


def _attach(writer: Writer, attachment: Attachment, log_ns: int) -> None:
    writer.attach(attachment.name, attachment.media_type, attachment.content, log_ns)
    writer.note(f"sha256:{attachment.name}", {"sha256": hashlib.sha256(attachment.content).hexdigest()})
