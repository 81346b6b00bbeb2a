"""``sim:``: a projector that lights the simulated bench. Options: ``bench=PATH``."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from endo3d.services.devices.bench import Bench, dark, default_path
from endo3d.services.devices.projector import Limits, ProjectorStatus
from endo3d.services.devices.uri import DeviceError, Setting, Uri
from endo3d_core import patterns
from endo3d_core.calibration import Rig
from endo3d_core.patterns import PatternSet

LEAD_NS = 5_000_000
"""From the start command to slot 0."""


def open_uri(uri: Uri, setting: Setting) -> SimProjector:
    path = Path(uri.text_of("bench", str(default_path(setting.rig))))
    uri.finish()
    window = Rig.from_yaml(setting.head_yaml).projector
    return SimProjector(Bench(path), window.width, window.height)


class SimProjector:
    """An ideal DLP with the timing limits of the DLPC900."""

    limits = Limits(min_exposure_us=4046.0, min_dark_us=105.0)

    def __init__(self, bench: Bench, width: int, height: int) -> None:
        self._bench, self._width, self._height = bench, width, height
        self._places: dict[str, tuple[int, ...]] = {}

    def load(self, sets: Sequence[PatternSet]) -> None:
        self._places = {}
        images: list[NDArray[np.uint8]] = []
        seen: dict[tuple[float, float, str, str, float], int] = {}
        for pattern_set in sets:
            places = []
            for p in pattern_set.patterns:
                look = (p.frequency, p.shift_rad, p.axis, p.wave, p.gamma)
                if look not in seen:
                    seen[look] = len(images)
                    images.append(patterns.image(p, self._width, self._height))
                places.append(seen[look])
            self._places[pattern_set.text] = tuple(places)
        self._bench.place(images)

    def start(self, pattern_set: PatternSet, exposure_us: float, dark_us: float) -> int:
        places = self._places.get(pattern_set.text)
        if places is None:
            raise DeviceError(f"pattern set {pattern_set.text!r} is not loaded; name it in the sequencer's modes")
        exposures = tuple(p.exposure_us or exposure_us for p in pattern_set.patterns)
        if min(exposures) < self.limits.min_exposure_us or dark_us < self.limits.min_dark_us:
            raise DeviceError(
                f"exposure {min(exposures):g} us and dark {dark_us:g} us are too short; the projector needs "
                f"{self.limits.min_exposure_us:g} and {self.limits.min_dark_us:g} us"
            )
        before = self._bench.read()
        start_ns = self.now_ns() + LEAD_NS
        self._bench.show(
            replace(
                before,
                running=True,
                start_ns=start_ns,
                dark_us=dark_us,
                exposures_us=exposures,
                images=places,
                begun_ns=before.begun_ns or start_ns,
            )
        )
        return start_ns

    def stop(self) -> None:
        self._bench.show(dark(self._bench.read()))

    def status(self) -> ProjectorStatus:
        return ProjectorStatus(connected=True, running=self._bench.read().running)

    def now_ns(self) -> int:
        return time.time_ns()

    def close(self) -> None:
        self.stop()
        self._bench.close()
