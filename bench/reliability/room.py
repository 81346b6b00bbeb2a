"""A room of its own for a campaign: mounts that nobody else on this machine sees.

A full disk and a full /dev/shm are made for real, on small file systems in a mount namespace of this process
and its children; they are gone when the last of them ends.
"""

from __future__ import annotations

import ctypes
import os
import subprocess
from pathlib import Path

CLONE_NEWNS = 0x00020000
SHM = Path("/dev/shm")


class Room:
    """To be entered before any thread is started. ``reason`` says why there is none, where there is none."""

    def __init__(self, disk: Path, disk_mb: int, shm_mb: int) -> None:
        """disk: an existing folder, that becomes a file system of ``disk_mb``."""
        self.disk = disk
        self.reason = _leave_the_common_room()
        if not self.reason:
            _mount(disk, disk_mb)
            _mount(SHM, shm_mb)

    def close(self) -> None:
        """Leave: whatever lies on the folder's file system is gone."""
        if not self.reason:
            subprocess.run(["umount", "--lazy", str(self.disk), str(SHM)], check=True)

    def fill(self, folder: Path, left_mb: int) -> None:
        """Leave ``left_mb`` on the file system of ``folder``."""
        stat = os.statvfs(folder)
        size = stat.f_bavail * stat.f_frsize - (left_mb << 20)
        with open(_filler(folder), "wb") as file:
            os.posix_fallocate(file.fileno(), 0, max(1, size))

    def clear(self, folder: Path) -> None:
        """Take back what ``fill`` took."""
        _filler(folder).unlink()


def _filler(folder: Path) -> Path:
    return folder / "filler"


def _leave_the_common_room() -> str:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(CLONE_NEWNS):
        return f"no mount namespace of its own: {os.strerror(ctypes.get_errno())}"
    done = subprocess.run(["mount", "--make-rprivate", "/"], capture_output=True, text=True)
    return done.stderr.strip()


def _mount(folder: Path, size_mb: int) -> None:
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size_mb}m,mode=1777", "tmpfs", str(folder)], check=True)
