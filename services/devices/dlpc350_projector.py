"""``dlpc350:``: TI LightCrafter 4500 over USB. It takes no pictures over USB: the patterns must be in its flash.

Options: ``first`` (flash image that holds the first pattern; the others follow, three of 8 bits per 24-bit image, in
the order of the sequencer's modes), ``led`` (1 red, 2 green, 4 blue, 7 white). Each pattern is triggered internally;
TRIG_OUT_1 goes to the camera. Source: TI DLPU010; the same framing as the DLPC900. No hardware and no emulator of it
was here: only its bytes are tested.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import usb.core

from endo3d.services.devices.dlp_link import VENDOR, DeviceGone, Link
from endo3d.services.devices.looks import looks
from endo3d.services.devices.projector import Limits, ProjectorStatus
from endo3d.services.devices.uri import DeviceError, Setting, Uri
from endo3d_core.patterns import PatternSet

PRODUCT = 0x6401
RUN, DISPLAY_MODE, SOURCE, TRIGGER_MODE, TIMES = 0x1A24, 0x1A1B, 0x1A22, 0x1A23, 0x1A29
LUT_CONTROL, LUT_WRITE, LUT_ACCESS, LUT_ADDRESS = 0x1A31, 0x1A34, 0x1A33, 0x1A32
VALIDATE, MAIN_STATUS = 0x1A1A, 0x1A0C
PATTERN_MODE, FROM_FLASH, INTERNAL_TRIGGER = 1, 3, 1
OPEN_LUT, OPEN_IMAGES, CLOSE = 2, 1, 0
STOP, START = 0, 2
PER_IMAGE = 3
ENTRIES = 128
MINIMUM_EXPOSURE_US = {1: 235, 8: 8333}
"""120 Hz for 8 bits."""
MINIMUM_DARK_US = 230
"""Between exposure and period, unless they are equal."""
INVALID = {
    1: "exposure or period out of range", 2: "pattern numbers out of range", 4: "trigger out 1 overlaps",
    8: "black vectors missing", 16: "period and exposure differ by less than 230 us",
}  # fmt: skip
Find = Callable[[], Any]
T = TypeVar("T")


def open_uri(uri: Uri, setting: Setting) -> Dlpc350Projector:
    if uri.body:
        raise DeviceError(f"device {uri.text!r}: write dlpc350: and options")
    first, led = int(uri.number("first", 0)), int(uri.number("led", 7))
    uri.finish()
    return Dlpc350Projector(lambda: usb.core.find(idVendor=VENDOR, idProduct=PRODUCT), first, led)


def lut_entry(number: int, depth: int, led: int, *, swap: bool, first: bool) -> bytes:
    """3 bytes: trigger and pattern number | depth and LED | buffer swap, and sharing of the trigger."""
    trigger = INTERNAL_TRIGGER if first or swap else 3  # 3: no trigger, goes on from the pattern before
    return bytes([trigger & 0b11 | number << 2, depth | led << 4, swap << 2])


class Dlpc350Projector:
    """Modes are sequences of patterns that lie in the flash; a switch rewrites the look-up table."""

    limits = Limits(float(MINIMUM_EXPOSURE_US[8]), float(MINIMUM_DARK_US))

    def __init__(self, find: Find, first_image: int, led: int) -> None:
        self._find, self._first_image, self._led = find, first_image, led
        self._members: dict[str, tuple[tuple[int, ...], int]] = {}
        """Per set: its patterns in the flash, and their depth."""
        self._link: Link | None = None
        self._lost = ""
        self._reaching(lambda link: link.read(MAIN_STATUS))

    def load(self, sets: Sequence[PatternSet]) -> None:
        loaded = looks(sets, 8, 8)  # the pictures are in the flash; only their order is needed
        self._members = {
            pattern_set.text: (members, loaded.looks[members[0]].depth)
            for pattern_set, members in zip(sets, loaded.members, strict=True)
        }
        self.stop()

    def start(self, pattern_set: PatternSet, exposure_us: float, dark_us: float) -> int:
        if pattern_set.text not in self._members:
            raise DeviceError(f"pattern set {pattern_set.text!r} is not loaded; name it in the sequencer's modes")
        members, depth = self._members[pattern_set.text]
        if pattern_set.exposures_us:
            raise DeviceError("the DLPC350 has one exposure for all patterns of a set: no exposures_us")
        if exposure_us < MINIMUM_EXPOSURE_US[depth] or 0 < dark_us < MINIMUM_DARK_US or len(members) > ENTRIES:
            raise DeviceError(
                f"{len(members)} patterns of {exposure_us:g} us and {dark_us:g} us dark are not possible: at most "
                f"{ENTRIES}, at least {MINIMUM_EXPOSURE_US[depth]} us, and no or {MINIMUM_DARK_US} us dark"
            )

        def start(link: Link) -> int:
            self._write_sequence(link, members, depth, round(exposure_us), round(exposure_us + dark_us))
            before_ns = self.now_ns()
            link.write(RUN, bytes([START]))
            return (before_ns + self.now_ns()) // 2

        return self._reaching(start)

    def _write_sequence(
        self, link: Link, members: tuple[int, ...], depth: int, exposure_us: int, period_us: int
    ) -> None:
        images = [self._first_image + member // PER_IMAGE for member in members]
        swaps = [k == 0 or images[k] != images[k - 1] for k in range(len(members))]
        loads = [image for image, swap in zip(images, swaps, strict=True) if swap]
        link.write(RUN, bytes([STOP]))
        link.write(DISPLAY_MODE, bytes([PATTERN_MODE]))
        link.write(SOURCE, bytes([FROM_FLASH]))
        link.write(LUT_CONTROL, bytes([len(members) - 1, 1, len(members) - 1, len(loads) - 1]))
        link.write(TRIGGER_MODE, bytes([INTERNAL_TRIGGER]))
        link.write(TIMES, struct.pack("<II", exposure_us, period_us))
        entries = b"".join(
            lut_entry(member % PER_IMAGE, depth, self._led, swap=swap, first=k == 0)
            for k, (member, swap) in enumerate(zip(members, swaps, strict=True))
        )
        for access, content in ((OPEN_LUT, entries), (OPEN_IMAGES, bytes(loads))):
            link.write(LUT_ACCESS, bytes([access]))
            link.write(LUT_ADDRESS, bytes([0]))
            link.write(LUT_WRITE, content)
            link.write(LUT_ACCESS, bytes([CLOSE]))
        link.write(VALIDATE, b"\0")
        wrong = link.read(VALIDATE)[0]
        if wrong:
            reasons = "; ".join(text for bit, text in INVALID.items() if wrong & bit)
            raise DeviceError(f"the projector rejects the sequence ({wrong:#04x}): {reasons or 'no reason given'}")

    def stop(self) -> None:
        self._reaching(lambda link: link.write(RUN, bytes([STOP])))

    def status(self) -> ProjectorStatus:
        try:
            state = self._reaching(lambda link: link.read(MAIN_STATUS)[0])
        except DeviceError as error:
            return ProjectorStatus(connected=False, running=False, note=self._lost or str(error))
        return ProjectorStatus(connected=True, running=bool(state & 2))

    def now_ns(self) -> int:
        return time.time_ns()

    def close(self) -> None:
        if self._link is None:
            return
        try:
            self._link.write(RUN, bytes([STOP]))
        except DeviceError:
            pass  # gone: nothing to stop that could be reached
        finally:
            self._link.close()
            self._link = None

    def _reaching(self, action: Callable[[Link], T]) -> T:
        """Act on the controller; when it turns out to be gone, it is opened anew the next time."""
        try:
            if self._link is None:
                self._link = Link(self._find, "DLPC350 projector")
                self._lost = ""
            return action(self._link)
        except DeviceGone as error:
            if self._link is not None:
                self._link.close()
            self._link, self._lost = None, str(error)
            raise
