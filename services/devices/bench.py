"""The optical bench of the simulated devices: a file that holds the light.

A simulated projector writes it (so does an emulated controller), a simulated camera reads it; they may live
in different processes, start in any order and die. Layout: a JSON header under a sequence counter, then the
pattern images.
"""

from __future__ import annotations

import json
import mmap
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from endo3d_core.slot_identity import Timeline

HEADER_BYTES = 65_536
IMAGES = 128
IMAGE_BYTES = 2048 * 1200


class NoLight(Exception):
    """The bench is being written by a process that died in the middle."""


@dataclass(frozen=True, slots=True)
class Shown:
    """What the projector shows."""

    running: bool = False
    start_ns: int = 0
    """Start of slot 0."""
    dark_us: float = 0.0
    exposures_us: tuple[float, ...] = ()
    """Per slot."""
    images: tuple[int, ...] = ()
    """Per slot: the place of its image."""
    width: int = 0
    height: int = 0
    placed: int = 0
    """Images that are held."""
    generation: int = 0
    """Counts replacements of the images."""
    begun_ns: int = 0
    """When light was first shown on this bench: the simulated world's time 0."""

    @property
    def timeline(self) -> Timeline | None:
        """When which slot is shown; None in the dark."""
        if not self.running:
            return None
        periods_ns = np.rint((np.array(self.exposures_us) + self.dark_us) * 1e3).astype(np.int64)
        return Timeline(self.start_ns, np.concatenate(([0], np.cumsum(periods_ns))), self.exposures_us)


def dark(shown: Shown) -> Shown:
    """The same bench without light."""
    return replace(shown, running=False, start_ns=0, dark_us=0.0, exposures_us=(), images=())


def default_path(rig: str) -> Path:
    """In memory where the system has such a place."""
    shared = Path("/dev/shm")
    return (shared if shared.is_dir() else Path(os.environ.get("TMPDIR", "/tmp"))) / f"endo3d-{rig}.bench"


class Bench:
    """The file, opened; made when absent."""

    def __init__(self, path: Path) -> None:
        self.path = path
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
        try:
            if os.fstat(descriptor).st_size < HEADER_BYTES + IMAGES * IMAGE_BYTES:
                os.ftruncate(descriptor, HEADER_BYTES + IMAGES * IMAGE_BYTES)  # sparse: only what is used exists
            self._map = mmap.mmap(descriptor, 0)
        finally:
            os.close(descriptor)
        self._counter = np.frombuffer(self._map, np.uint64, 1)
        self._length = np.frombuffer(self._map, np.uint64, 1, 8)
        self._bytes = np.frombuffer(self._map, np.uint8)

    def place(self, images: Sequence[NDArray[np.uint8]]) -> None:
        """Replace the pattern images, all (height, width) alike; the light goes out."""
        height, width = images[0].shape
        if len(images) > IMAGES or height * width > IMAGE_BYTES:
            raise ValueError(f"the bench holds {IMAGES} images of {IMAGE_BYTES} bytes at most")
        before = self.read()
        self.show(dark(before))
        for i, image in enumerate(images):
            start = HEADER_BYTES + i * IMAGE_BYTES
            self._bytes[start : start + height * width].reshape(height, width)[:] = image
        held = replace(before, width=width, height=height, placed=len(images), generation=before.generation + 1)
        self.show(dark(held))

    def image(self, place: int, shown: Shown) -> NDArray[np.uint8]:
        """(height, width) copy of one image."""
        start = HEADER_BYTES + place * IMAGE_BYTES
        return self._bytes[start : start + shown.height * shown.width].reshape(shown.height, shown.width).copy()

    def show(self, shown: Shown) -> None:
        """Change what is shown, at once and as a whole."""
        text = json.dumps(asdict(shown)).encode()
        self._counter[0] |= np.uint64(1)  # odd: being written; also after a writer that died
        self._length[0] = len(text)
        self._bytes[16 : 16 + len(text)] = np.frombuffer(text, np.uint8)
        self._counter[0] += np.uint64(1)

    def read(self) -> Shown:
        """What is shown now."""
        for _ in range(10_000):
            before = int(self._counter[0])
            length = int(self._length[0])
            if before == 0:
                return Shown()
            text = self._bytes[16 : 16 + min(length, HEADER_BYTES - 16)].tobytes()
            if before % 2 == 0 and int(self._counter[0]) == before:
                fields = json.loads(text)
                fields["exposures_us"], fields["images"] = (
                    tuple(fields["exposures_us"]),
                    tuple(fields["images"]),
                )
                return Shown(**fields)
        raise NoLight(f"{self.path} is left half written; remove it and restart the sequencer")

    @property
    def changes(self) -> int:
        """Counts changes: cheap to compare before reading again."""
        return int(self._counter[0])

    def close(self) -> None:
        """Unmap; the file stays, so that whoever is left goes on."""
        if self._map.closed:
            return
        del self._counter, self._length, self._bytes
        self._map.close()
