"""``alp:``: ViALUX ALP-4 controllers (DLP4100 and later) through ALP4lib (``endo3d[alp]``) and ViALUX' library.

Options: ``version`` (4.3 by default), ``library`` (folder of the vendor's library), ``pulse_us`` (length of the
camera's trigger). One sequence per pattern set lies in the controller's memory. No hardware was here to try it with.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from endo3d.services.devices.looks import looks
from endo3d.services.devices.projector import Limits, ProjectorStatus
from endo3d.services.devices.uri import DeviceError, Setting, Uri
from endo3d_core.calibration import Rig
from endo3d_core.patterns import PatternSet


def open_uri(uri: Uri, setting: Setting) -> AlpProjector:
    version, library = uri.text_of("version", "4.3"), uri.text_of("library", "")
    pulse_us = int(uri.number("pulse_us", 100))
    uri.finish()
    try:
        from ALP4 import ALP4
    except ImportError:
        raise DeviceError("ALP4lib is not installed; pip install 'endo3d[alp]'") from None
    try:
        controller = ALP4(version=version, libDir=library or None)
        controller.Initialize()
    except Exception as error:  # whatever loading and opening a vendor's library raises
        raise DeviceError(
            f"no ALP controller ({error}); install ViALUX' ALP-{version}, name its folder by library=, and plug it in"
        ) from error
    lens = Rig.from_yaml(setting.head_yaml).projector
    return AlpProjector(controller, (lens.width, lens.height), pulse_us)


class AlpProjector:
    """Times of a sequence can be set while it is stopped; nothing is uploaded then."""

    limits = Limits(min_exposure_us=3500.0, min_dark_us=44.0)
    """8-bit greys of an ALP-4.1 run at 290 Hz; the controller itself refuses what it can't do."""

    def __init__(self, controller: Any, window: tuple[int, int], pulse_us: int) -> None:
        self._alp, self._window, self._pulse_us = controller, window, pulse_us
        self._sequences: dict[str, Any] = {}
        self._running = False

    def load(self, sets: Sequence[PatternSet]) -> None:
        self.stop()
        for sequence in self._sequences.values():
            self._alp.FreeSeq(sequence)
        self._sequences = {}
        loaded = looks(sets, *self._window)
        for pattern_set, members in zip(sets, loaded.members, strict=True):
            kinds = [loaded.looks[member] for member in members]
            sequence = self._alp.SeqAlloc(nbImg=len(kinds), bitDepth=kinds[0].depth)
            scale = 255 // (2 ** kinds[0].depth - 1)
            pictures = [self._on_dmd(look.image * np.uint8(scale)) for look in kinds]
            self._alp.SeqPut(imgData=np.concatenate([picture.ravel() for picture in pictures]), SequenceId=sequence)
            self._sequences[pattern_set.text] = sequence

    def _on_dmd(self, window: Any) -> Any:
        """The window in the middle of the mirrors, black around it."""
        height, width = window.shape
        full = np.zeros((self._alp.nSizeY, self._alp.nSizeX), np.uint8)
        top, left = (full.shape[0] - height) // 2, (full.shape[1] - width) // 2
        if top < 0 or left < 0:
            raise DeviceError(f"a pattern window of {width}x{height} does not fit {full.shape[1]}x{full.shape[0]}")
        full[top : top + height, left : left + width] = window
        return full

    def start(self, pattern_set: PatternSet, exposure_us: float, dark_us: float) -> int:
        sequence = self._sequences.get(pattern_set.text)
        if sequence is None:
            raise DeviceError(f"pattern set {pattern_set.text!r} is not loaded; name it in the sequencer's modes")
        if pattern_set.exposures_us:
            raise DeviceError("an ALP sequence has one exposure for all its patterns: no exposures_us")
        if exposure_us < self.limits.min_exposure_us or dark_us < self.limits.min_dark_us:
            raise DeviceError(
                f"exposure {exposure_us:g} us and dark {dark_us:g} us are too short; the projector needs "
                f"{self.limits.min_exposure_us:g} and {self.limits.min_dark_us:g} us"
            )
        self.stop()
        self._alp.SetTiming(
            SequenceId=sequence,
            illuminationTime=round(exposure_us),
            pictureTime=round(exposure_us + dark_us),
            synchDelay=0,
            synchPulseWidth=self._pulse_us,
        )
        before_ns = self.now_ns()
        self._alp.Run(SequenceId=sequence, loop=True)
        self._running = True
        return (before_ns + self.now_ns()) // 2

    def stop(self) -> None:
        if self._running:
            self._alp.Halt()
        self._running = False

    def status(self) -> ProjectorStatus:
        return ProjectorStatus(connected=True, running=self._running)

    def now_ns(self) -> int:
        return time.time_ns()

    def close(self) -> None:
        self.stop()
        self._alp.Free()
