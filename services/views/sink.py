"""Where entries go: a file, or a Rerun viewer that may stall or die without anybody waiting for it.

Rerun's ``log`` queues without end and then blocks; ``flush`` with a time limit tells whether the other side
takes what it gets. So never more than ``WINDOW_BYTES`` are under way, and while they stay under way nothing
is added: new entries are counted as lost, and the newest of each path is what is seen when it goes on.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Protocol

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from endo3d.services.views.entries import Entry, world

WINDOW_BYTES = 4 << 20
PATIENCE_S = 0.05
"""The longest a step waits for a slow viewer."""
GOODBYE_S = 2.0
STALLED_RETRY_NS, GONE_RETRY_NS = 500_000_000, 2_000_000_000
"""How soon a viewer is asked again, by the messages' own time."""
APPLICATION, TIMELINE = "endo3d", "time"


class Sink(Protocol):
    """Takes entries; never waits long."""

    def log(self, stamp_ns: int, entry: Entry) -> None: ...

    def lay_out(self, blueprint: rrb.Blueprint) -> None: ...

    def close(self) -> None: ...


class FileSink:
    """Writes an .rrd recording, all of it."""

    def __init__(self, path: Path, blueprint: rrb.Blueprint) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._recording = rr.RecordingStream(APPLICATION)
        self._recording.save(path, default_blueprint=blueprint)
        _log_all(self._recording, world())

    def log(self, stamp_ns: int, entry: Entry) -> None:
        _log(self._recording, stamp_ns, entry)

    def lay_out(self, blueprint: rrb.Blueprint) -> None:
        """Replaces the layout."""
        self._recording.send_blueprint(blueprint)

    def close(self) -> None:
        self._recording.flush()
        self._recording.disconnect()


class ViewerSink:
    """Sends to a viewer over gRPC, as fast as that takes it; connects again when it was lost."""

    def __init__(
        self,
        url: str,
        blueprint: rrb.Blueprint,
        revive: Callable[[], bool] = lambda: True,
        patience_s: float = PATIENCE_S,
    ) -> None:
        """revive: called when the viewer is gone; says whether it is worth connecting again."""
        self.url = url
        self.patience_s = patience_s
        self.lost = 0
        """Entries that the viewer wasn't ready for."""
        self.trouble = ""
        self._blueprint = blueprint
        self._revive = revive
        self._statics: dict[tuple[str, type], Entry] = {}
        self._under_way = 0
        self._retry_ns = 0
        self._severed = self._given_up = False
        self._recording = rr.RecordingStream(APPLICATION)
        self._connect()

    def log(self, stamp_ns: int, entry: Entry) -> None:
        if entry.static:
            self._statics[entry.path, type(entry.what)] = entry
        if self._given_up:
            return
        if self.trouble and not self._recovered(stamp_ns):
            self.lost += 1
            return
        _log(self._recording, stamp_ns, entry)
        self._under_way += entry.size
        if self._under_way > WINDOW_BYTES:
            self._drained(stamp_ns)

    def lay_out(self, blueprint: rrb.Blueprint) -> None:
        """Replaces the layout, also for a viewer that comes back."""
        self._blueprint = blueprint
        if not self.trouble:
            self._recording.send_blueprint(blueprint)

    def close(self) -> None:
        """Says goodbye to a viewer that listens; one that doesn't is left to itself."""
        try:
            self._recording.flush(timeout_sec=GOODBYE_S)
            self._recording.disconnect()
        except RuntimeError:
            # rerun's own farewell at exit would wait for the stalled viewer for ever
            rr.unregister_shutdown()
            threading.Thread(target=self._recording.disconnect, daemon=True).start()

    def _connect(self) -> None:
        self._recording.connect_grpc(self.url, default_blueprint=self._blueprint)
        _log_all(self._recording, (*world(), *self._statics.values()))

    def _recovered(self, stamp_ns: int) -> bool:
        """Looks again now and then."""
        if stamp_ns < self._retry_ns <= stamp_ns + GONE_RETRY_NS:
            return False
        if self._severed:
            if not self._revive():
                self._given_up, self.trouble = True, ""
                return False
            self._connect()
        return self._drained(stamp_ns)

    def _drained(self, stamp_ns: int) -> bool:
        """Whether everything sent so far has arrived."""
        try:
            self._recording.flush(timeout_sec=self.patience_s)
        except RuntimeError as error:
            self._severed = "timed out" not in str(error)
            state = "is gone" if self._severed else "doesn't take what it gets"
            self.trouble = f"the Rerun viewer at {self.url} {state}: restart it; nothing waits for it"
            self._retry_ns = stamp_ns + (GONE_RETRY_NS if self._severed else STALLED_RETRY_NS)
            return False
        self.trouble, self._severed, self._under_way = "", False, 0
        return True


def _log(recording: rr.RecordingStream, stamp_ns: int, entry: Entry) -> None:
    if not entry.static:
        recording.set_time(TIMELINE, timestamp=np.datetime64(stamp_ns, "ns"))
    recording.log(entry.path, entry.what, static=entry.static)


def _log_all(recording: rr.RecordingStream, entries: Iterable[Entry]) -> None:
    for entry in entries:
        _log(recording, 0, entry)
