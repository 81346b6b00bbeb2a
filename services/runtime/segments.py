"""Leaves nothing behind in /dev/shm.

zenoh removes a pool with its provider, but not its own bookkeeping, and nothing when an interpreter exits
with arrays alive; what killed processes left it removes at the next start. Every user of a segment holds a
shared lock on its file, so whoever gets the exclusive lock is the last one and may unlink it.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections import defaultdict
from pathlib import Path

_OPEN_FILES = Path("/proc/self/fd")


def unlink_unused() -> None:
    """Unlink the segments that this process has open and no other process uses.

    Only at the end of a process: it gives up its own locks, and zenoh keeps one segment for all its sessions.
    """
    for path, descriptors in _open_segments().items():
        with contextlib.suppress(OSError):  # somebody else's, gone, or zenoh's threads have just closed it
            for descriptor in descriptors[1:]:
                fcntl.flock(descriptor, fcntl.LOCK_UN)
            fcntl.flock(descriptors[0], fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink()


def _open_segments() -> dict[Path, list[int]]:
    segments: dict[Path, list[int]] = defaultdict(list)
    for entry in _OPEN_FILES.iterdir():
        with contextlib.suppress(FileNotFoundError):  # the listing's own descriptor
            path = Path(os.readlink(entry))
            if path.suffix == ".zenoh" and path.parent == Path("/dev/shm"):
                segments[path].append(int(entry.name))
    return segments
