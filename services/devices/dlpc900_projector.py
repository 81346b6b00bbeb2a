"""``dlpc900:``: TI LightCrafter 6500 and 9000 over USB. ``dlpc900:SERIAL`` names one of several;
``dlpc900:emulated`` is an emulated controller that lights the simulated bench.

Options: ``x``, ``y`` (pixels by which the pattern window stands right of and below the DMD's centre),
``rise_us``, ``fall_us``, ``invert=1`` (edges of both trigger outputs). Emulated: ``bench=PATH``,
``dmd=9000``.

TRIG_OUT_1 goes to the camera; TRIG_OUT_2 fires at slot 0 only. The lamp must be gated by the controller: the
low bits of an 8-bit pattern are made by the LED.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
import usb.core
from numpy.typing import NDArray

from endo3d.services.devices.dlp_link import VENDOR, DeviceGone, Rejected
from endo3d.services.devices.dlpc900_controller import (
    FAULTS,
    PRODUCT,
    Controller,
    State,
    TriggerOut,
)
from endo3d.services.devices.dlpc900_image import Place, pack, places, upload
from endo3d.services.devices.dlpc900_lut import ENTRIES, LONGEST_US, Entry
from endo3d.services.devices.looks import Look, looks
from endo3d.services.devices.projector import Limits, ProjectorStatus
from endo3d.services.devices.uri import DeviceError, Setting, Uri
from endo3d_core.calibration import Rig
from endo3d_core.patterns import PatternSet

MINIMUM_DARK_US = 105
T = TypeVar("T")
Find = Callable[[], Any]


def open_uri(uri: Uri, setting: Setting) -> Dlpc900Projector:
    offset = (int(uri.number("x", 0)), int(uri.number("y", 0)))
    trigger = TriggerOut(int(uri.number("rise_us", 0)), int(uri.number("fall_us", 0)), bool(uri.number("invert", 0)))
    lens = Rig.from_yaml(setting.head_yaml).projector
    if uri.body == "emulated":
        from endo3d.services.devices.emulated.light import plugged_in

        find = plugged_in(uri, setting, (lens.width, lens.height), offset)
    else:
        find = on_usb(uri.body)
    uri.finish()
    if not all(-20 <= edge_us <= 20_000 for edge_us in (trigger.rise_us, trigger.fall_us)):
        raise DeviceError(f"device {uri.text!r}: rise_us and fall_us are -20..20000")
    return Dlpc900Projector(find, (lens.width, lens.height), offset, trigger)


def on_usb(serial: str = "") -> Find:
    """How to find the controller, again and again."""
    match = {"serial_number": serial} if serial else {}
    return lambda: usb.core.find(idVendor=VENDOR, idProduct=PRODUCT, **match)


class Dlpc900Projector:
    """Holds every pattern set in the controller's memory; a reorder command switches between them."""

    def __init__(
        self,
        find: Find,
        window: tuple[int, int],
        offset: tuple[int, int] = (0, 0),
        trigger: TriggerOut = TriggerOut(),  # noqa: B008 - frozen
    ) -> None:
        """``window``: (width, height) of the patterns; ``offset``: of its centre from the DMD's, px."""
        self._find, self._window, self._offset, self._trigger = find, window, offset, trigger
        self._sets: tuple[PatternSet, ...] = ()
        self._first: dict[str, int] = {}
        """Where a set's entries begin in the look-up table."""
        self._entries: list[Entry] = []
        self._uploaded = False
        self._lost = ""
        self._controller: Controller | None = None
        self._connect()

    def _connect(self) -> Controller:
        """The open controller; opened anew after it was lost, and then empty."""
        if self._controller is None:
            self._uploaded = False
            self._controller = Controller(self._find)
            self._lost = ""
        return self._controller

    @property
    def limits(self) -> Limits:
        return Limits(float(self._connect().minimum_exposures_us[7]), MINIMUM_DARK_US)

    def load(self, sets: Sequence[PatternSet]) -> None:
        before, self._sets = self._sets, tuple(sets)
        try:
            self._reaching(self._upload)
        except DeviceError:
            self._sets = before
            raise

    def start(self, pattern_set: PatternSet, exposure_us: float, dark_us: float) -> int:
        def start(controller: Controller) -> int:
            if not self._uploaded:
                self._upload(controller)
            if pattern_set.text not in self._first:
                raise DeviceError(f"pattern set {pattern_set.text!r} is not loaded; name it in the sequencer's modes")
            self._check(controller, pattern_set, exposure_us, dark_us)
            try:
                return self._show(controller, pattern_set, exposure_us, dark_us)
            except Rejected:
                # It may have lost its memory in a power cut too short to be seen on USB.
                self._upload(controller)
                return self._show(controller, pattern_set, exposure_us, dark_us)

        return self._reaching(start)

    def stop(self) -> None:
        self._reaching(Controller.stop)

    def status(self) -> ProjectorStatus:
        def status(controller: Controller) -> ProjectorStatus:
            hardware, state = controller.hardware(), controller.state()
            faults = "; ".join(text for flag, text in FAULTS.items() if hardware & flag)
            return ProjectorStatus(True, bool(state & State.RUNNING), faults)

        try:
            return self._reaching(status)
        except DeviceError as error:
            return ProjectorStatus(connected=False, running=False, note=self._lost or str(error))

    def now_ns(self) -> int:
        return time.time_ns()

    def close(self) -> None:
        if self._controller is None:
            return
        try:
            self._controller.stop()
        except DeviceError:
            pass  # gone: nothing to stop that could be reached
        finally:
            self._controller.close()
            self._controller = None

    def _reaching(self, action: Callable[[Controller], T]) -> T:
        """Act on the controller; when it turns out to be gone, it is opened anew the next time."""
        try:
            return action(self._connect())
        except DeviceGone as error:
            if self._controller is not None:
                self._controller.close()
            self._controller, self._lost = None, str(error)
            raise

    def _upload(self, controller: Controller) -> None:
        """Look-up table and images of all sets, in the order that the controller wants."""
        loaded = looks(self._sets, *self._window)
        try:
            found = places([look.depth for look in loaded.looks], [look.axis for look in loaded.looks])
        except ValueError as error:
            raise DeviceError(f"{error}; load fewer modes") from error
        self._uploaded = False
        self._first, self._entries = {}, []
        for pattern_set, members in zip(self._sets, loaded.members, strict=True):
            self._first[pattern_set.text] = len(self._entries)
            self._entries += [
                Entry(found[member], controller.minimum_exposures_us[7], MINIMUM_DARK_US, slot == 0)
                for slot, member in enumerate(members)
            ]
        if len(self._entries) > ENTRIES:
            raise DeviceError(f"{len(self._entries)} patterns in all modes; the projector takes {ENTRIES}")
        controller.on_the_fly()
        for number in (1, 2):
            controller.trigger_out(number, self._trigger)
        for index, entry in enumerate(self._entries):
            controller.entry(index, entry)
        controller.count(len(self._entries))
        for index, members_of_image in _by_image_descending(found, loaded.looks):
            pixels = self._on_dmd(controller, pack(members_of_image))
            for half, part in enumerate(np.split(pixels, controller.halves, axis=1)):
                controller.image(half, index, upload(part))
        controller.count(len(self._entries))
        self._uploaded = True

    def _on_dmd(self, controller: Controller, window: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """(DMD height, DMD width, 3): the window in its place, black around it."""
        (width, height), (x, y) = self._window, self._offset
        left, top = (controller.width - width) // 2 + x, (controller.height - height) // 2 + y
        if left < 0 or top < 0 or left + width > controller.width or top + height > controller.height:
            raise DeviceError(
                f"a pattern window of {width}x{height} at {left}, {top} does not fit the "
                f"{controller.dmd}'s {controller.width}x{controller.height}; see the head's projector section"
            )
        pixels = np.zeros((controller.height, controller.width, 3), np.uint8)
        pixels[top : top + height, left : left + width] = window
        return pixels

    def _check(self, controller: Controller, pattern_set: PatternSet, exposure_us: float, dark_us: float) -> None:
        """Against what this very device says of itself. Raises ``DeviceError``."""
        if not MINIMUM_DARK_US <= dark_us <= LONGEST_US:
            raise DeviceError(f"dark {dark_us:g} us is too short; the projector needs {MINIMUM_DARK_US} us")
        first = self._first[pattern_set.text]
        for entry, pattern in zip(self._entries[first:], pattern_set.patterns, strict=False):
            wanted_us = round(pattern.exposure_us or exposure_us)
            shortest_us = controller.minimum_exposures_us[entry.place.depth - 1]
            if not shortest_us <= wanted_us <= LONGEST_US:
                raise DeviceError(
                    f"exposure {wanted_us} us is too short or too long; the projector needs {shortest_us} us "
                    f"for {entry.place.depth}-bit patterns, and takes {LONGEST_US} us at most"
                )

    def _show(self, controller: Controller, pattern_set: PatternSet, exposure_us: float, dark_us: float) -> int:
        """Times that changed go into the look-up table, the set's entries into the order; no upload."""
        controller.stop()
        first, changed = self._first[pattern_set.text], False
        for index, pattern in enumerate(pattern_set.patterns, first):
            entry = replace(
                self._entries[index],
                exposure_us=round(pattern.exposure_us or exposure_us),
                dark_us=round(dark_us),
            )
            if entry != self._entries[index]:
                controller.entry(index, entry)
                self._entries[index], changed = entry, True
        if changed:
            controller.count(len(self._entries))
        controller.order(range(first, first + len(pattern_set)))
        before_ns = self.now_ns()
        controller.start()
        return (before_ns + self.now_ns()) // 2 + self._trigger.rise_us * 1000


def _by_image_descending(
    found: Sequence[Place], loaded: Sequence[Look]
) -> list[tuple[int, list[tuple[Place, NDArray[np.uint8]]]]]:
    """Image index and its patterns, the last image first: the order in which they are uploaded."""
    by_image: dict[int, list[tuple[Place, NDArray[np.uint8]]]] = {}
    for place, look in zip(found, loaded, strict=True):
        by_image.setdefault(place.image, []).append((place, look.image))
    return sorted(by_image.items(), reverse=True, key=lambda item: item[0])
