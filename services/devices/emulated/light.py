"""The emulated controller's light on the simulated bench: what its mirrors show is what the camera sees."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import usb.core
from numpy.typing import NDArray

from endo3d.services.devices.bench import Bench, dark, default_path
from endo3d.services.devices.emulated.dlpc900 import DMDS, Dlpc900, Show
from endo3d.services.devices.emulated.usb_port import PRODUCT, VENDOR, UsbPort
from endo3d.services.devices.uri import DeviceError, Setting, Uri

LATENCY_NS = 1_000_000
"""From the start command to the first pattern."""


def plugged_in(uri: Uri, setting: Setting, window: tuple[int, int], offset: tuple[int, int]) -> Callable[[], Any]:
    """How to find an emulated controller on an emulated USB port. Raises ``DeviceError``."""
    path = Path(uri.text_of("bench", str(default_path(setting.rig))))
    name = f"DLP{uri.text_of('dmd', '6500')}"
    cable = uri.text_of("cable", "")
    kinds = {of: kind for kind, (of, *_) in DMDS.items()}
    if name not in kinds:
        raise DeviceError(f"device {uri.text!r}: there is an emulated {' and a '.join(kinds)}, no {name}")
    light = Light(Bench(path), window, offset)
    port = UsbPort(Dlpc900(kinds[name], light.show, light.dark), Path(cable) if cable else None)
    return lambda: usb.core.find(idVendor=VENDOR, idProduct=PRODUCT, backend=port)


class Light:
    """Puts the pattern window of whatever the mirrors show onto the bench."""

    def __init__(self, bench: Bench, window: tuple[int, int], offset: tuple[int, int] = (0, 0)) -> None:
        """``window``: (width, height); ``offset`` of its centre from the mirrors' centre, px."""
        self._bench, self._window, self._offset = bench, window, offset
        self._held: dict[bytes, int] = {}
        self._images: list[NDArray[np.uint8]] = []

    def show(self, show: Show) -> None:
        """Begin the sequence; images that lie on the bench stay there."""
        arrived_ns = time.time_ns()
        places, held = [], len(self._images)
        for pattern in show.patterns:
            image = self._in_window(pattern.pixels) * np.uint8(255 // (2**pattern.depth - 1))
            key = image.tobytes()
            if key not in self._held:
                self._held[key] = len(self._images)
                self._images.append(image)
            places.append(self._held[key])
        if len(self._images) > held:
            self._bench.place(self._images)
        before = self._bench.read()
        start_ns = max(arrived_ns + LATENCY_NS, time.time_ns())
        self._bench.show(
            replace(
                before,
                running=True,
                start_ns=start_ns,
                dark_us=float(show.patterns[0].dark_us),
                exposures_us=tuple(float(pattern.exposure_us) for pattern in show.patterns),
                images=tuple(places),
                begun_ns=before.begun_ns or start_ns,
            )
        )

    def dark(self) -> None:
        self._bench.show(dark(self._bench.read()))

    def _in_window(self, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        (width, height), (x, y) = self._window, self._offset
        left, top = (pixels.shape[1] - width) // 2 + x, (pixels.shape[0] - height) // 2 + y
        return np.ascontiguousarray(pixels[top : top + height, left : left + width])
