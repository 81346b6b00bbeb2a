"""``folder:PATH``: images of a folder, in the order of their names, one per projected pattern, for ever.

The k-th pattern since the projector's start shows the k-th image (modulo their number), so a folder holds whole
sequences. It follows the simulated bench (``projector = "sim:"``). Options: ``bench`` (path).
"""

from __future__ import annotations

import time
from collections import deque
from pathlib import Path
from typing import Any

from numpy.typing import DTypeLike, NDArray

from endo3d.services.devices.bench import Bench, default_path
from endo3d.services.devices.camera import Shot
from endo3d.services.devices.grey_image import read_grey
from endo3d.services.devices.uri import DeviceError, Setting, Uri
from endo3d_core.slot_identity import Timeline

SUFFIXES = {".png", ".tif", ".tiff", ".bmp", ".pgm", ".jpg", ".jpeg"}


def open_uri(uri: Uri, setting: Setting) -> FolderCamera:
    bench = Path(uri.text_of("bench", str(default_path(setting.rig))))
    uri.finish()
    folder = Path(uri.body).expanduser()
    try:
        paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
    except OSError as error:
        raise DeviceError(f"device {uri.text!r}: {error.strerror}; write folder:PATH") from error
    if not paths:
        raise DeviceError(f"device {uri.text!r}: no image in {folder} ({', '.join(sorted(SUFFIXES))})")
    return FolderCamera([_read(path) for path in paths], paths, Bench(bench))


def _read(path: Path) -> NDArray[Any]:
    try:
        return read_grey(path)
    except ValueError as error:
        raise DeviceError(str(error)) from error


class FolderCamera:
    """All images in memory, shown to the beat of the bench."""

    def __init__(self, images: list[NDArray[Any]], paths: list[Path], bench: Bench) -> None:
        for path, image in zip(paths, images, strict=True):
            if image.shape != images[0].shape or image.dtype != images[0].dtype:
                raise DeviceError(f"{path} is {image.shape} {image.dtype}, unlike {paths[0]}: one size per folder")
        self._images, self._bench = images, bench
        self.shape: tuple[int, int] = images[0].shape[:2]
        self.corner, self.bin_px = (0, 0), None
        self._lent: deque[NDArray[Any]] = deque()
        self._timeline: Timeline | None = None
        self._changes = -1
        self._next = 0
        self._frame_id = -1
        self._losses = {"underrun": 0}

    @property
    def dtype(self) -> DTypeLike:
        return self._images[0].dtype

    def arm(self) -> None:
        self._look()
        if self._timeline is not None:
            self._next = max(0, self._timeline.last_begun(self.now_ns()) + 1)

    def lend(self, image: NDArray[Any]) -> None:
        self._lent.append(image)

    def wait(self, timeout_s: float) -> Shot | None:
        deadline_ns = self.now_ns() + round(timeout_s * 1e9)
        self._look()
        if self._timeline is None:
            _sleep_until(deadline_ns)
            return None
        exposure_us = self._timeline.exposures_us[self._next % self._timeline.slots]
        trigger_ns = self._timeline.trigger_ns(self._next)
        ends_ns = trigger_ns + round(exposure_us * 1e3)
        _sleep_until(min(ends_ns, deadline_ns))
        if ends_ns > deadline_ns:
            return None
        source = self._images[self._next % len(self._images)]
        self._next += 1
        self._frame_id += 1
        if not self._lent:
            self._losses["underrun"] += 1
            return None
        image = self._lent.popleft()
        image[:] = source
        return Shot(image, trigger_ns, self._frame_id, exposure_us)

    def _look(self) -> None:
        """Take over what the projector shows when it has changed."""
        if self._bench.changes == self._changes:
            return
        self._changes = self._bench.changes
        self._next = 0
        self._timeline = self._bench.read().timeline

    def set_exposure(self, exposure_us: float) -> None:
        """The images were exposed long ago."""

    def now_ns(self) -> int:
        return time.time_ns()

    def losses(self) -> dict[str, int]:
        return dict(self._losses)

    def close(self) -> None:
        self._lent.clear()
        self._bench.close()


def _sleep_until(stamp_ns: int) -> None:
    time.sleep(max(0, stamp_ns - time.time_ns()) * 1e-9)
