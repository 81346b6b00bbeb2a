"""The DLPC900's commands by name: what goes into each, what comes back. Source: TI DLPU018."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntFlag
from typing import Any

from endo3d.services.devices.dlp_link import Link
from endo3d.services.devices.dlpc900_image import HEADER_BYTES
from endo3d.services.devices.dlpc900_lut import Entry
from endo3d.services.devices.uri import DeviceError

PRODUCT = 0xC900

POWER = 0x0200
VERSIONS, DMD_TYPE = 0x0205, 0x0206
HARDWARE, MEMORY_TEST, STATE = 0x1A0A, 0x1A0B, 0x1A0C
DISPLAY_MODE, RUN = 0x1A1B, 0x1A24
TRIGGER_OUT = (0x1A1D, 0x1A1E)
TRIGGER_IN_1 = 0x1A35
IMAGE_BEGIN, IMAGE_PART = (0x1A2A, 0x1A2C), (0x1A2B, 0x1A2D)
"""Primary and secondary controller."""
LUT_COUNT, LUT_ORDER, LUT_ENTRY = 0x1A31, 0x1A32, 0x1A34
MINIMUM_EXPOSURES = 0x1A42

PART_BYTES = 504
ORDER_ENTRIES = (512 - 6 - 6) // 2
"""As many as the device's command buffer of 512 bytes holds."""
NORMAL, ON_THE_FLY, STOP, START, FOREVER = 0, 3, 0, 2, 0

DMDS = {
    1: ("DLP6500", 1920, 1080), 2: ("DLP9000", 2560, 1600), 3: ("DLP670S", 2716, 1600),
    4: ("DLP500YX", 2048, 1200), 5: ("DLP5500", 1024, 768),
}  # fmt: skip
"""Name, width, height."""


class Hardware(IntFlag):
    INITIALISED = 1
    INCOMPATIBLE = 2
    RESET_CONTROLLER_ERROR = 4
    FORCED_SWAP = 8
    SECONDARY_PRESENT = 16
    SEQUENCER_ABORT = 64
    SEQUENCER_ERROR = 128


class State(IntFlag):
    PARKED = 1
    RUNNING = 2
    FROZEN = 4
    SOURCE_LOCKED = 8


FAULTS = {
    Hardware.INCOMPATIBLE: "the DMD does not fit the controller's firmware",
    Hardware.RESET_CONTROLLER_ERROR: "the DMD's reset controller failed",
    Hardware.FORCED_SWAP: "a forced buffer swap: patterns may have been torn",
    Hardware.SEQUENCER_ABORT: "the sequencer aborted",
    Hardware.SEQUENCER_ERROR: "the sequencer reports an error",
}


@dataclass(frozen=True, slots=True)
class TriggerOut:
    """Edges relative to the start and the end of an exposure, -20..20000 us."""

    rise_us: int = 0
    fall_us: int = 0
    inverted: bool = False

    def pack(self) -> bytes:
        return struct.pack("<Bhh", self.inverted, self.rise_us, self.fall_us)


class Controller:
    """An opened DLPC900. Every method raises ``Rejected``, ``DeviceGone`` or ``DeviceError``."""

    def __init__(self, find: Callable[[], Any]) -> None:
        self.link = Link(find, "DLPC900 projector")
        if self.state() & State.PARKED:
            self.link.write(POWER, bytes([NORMAL]))
        kind = self.link.read(DMD_TYPE)[0]
        if kind not in DMDS:
            raise DeviceError(f"the projector has a DMD of unknown type {kind}; endo3d knows {sorted(DMDS)}")
        self.dmd, self.width, self.height = DMDS[kind]
        self.halves = 2 if self.hardware() & Hardware.SECONDARY_PRESENT else 1
        """Controllers that share the image side by side."""
        if not self.link.read(MEMORY_TEST)[0] & 1:
            raise DeviceError("the projector's memory test failed; switch it off and on, or have it repaired")
        self.firmware = ".".join(str(part) for part in _version(self.link.read(VERSIONS)))
        self.minimum_exposures_us = struct.unpack_from("<8H", self.link.read(MINIMUM_EXPOSURES))
        """For patterns of 1..8 bits."""

    def hardware(self) -> Hardware:
        return Hardware(self.link.read(HARDWARE)[0])

    def state(self) -> State:
        return State(self.link.read(STATE)[0])

    def stop(self) -> None:
        """The next start begins at the first pattern."""
        self.link.write(RUN, bytes([STOP]))

    def start(self) -> None:
        self.link.write(RUN, bytes([START]))

    def on_the_fly(self) -> None:
        """Take patterns over USB. Stops, as a change of the display mode asks for."""
        self.stop()
        self.link.write(DISPLAY_MODE, bytes([ON_THE_FLY]))
        self.stop()

    def entry(self, index: int, entry: Entry) -> None:
        self.link.write(LUT_ENTRY, entry.pack(index))

    def count(self, entries: int) -> None:
        """How many entries of the look-up table hold, shown for ever."""
        self.link.write(LUT_COUNT, struct.pack("<HI", entries, FOREVER))

    def order(self, indices: Sequence[int]) -> None:
        """Show these entries in this order, for ever; what is loaded stays loaded."""
        if len(indices) > ORDER_ENTRIES:
            raise DeviceError(f"a pattern set has at most {ORDER_ENTRIES} patterns on this projector")
        self.link.write(LUT_ORDER, struct.pack(f"<HI{len(indices)}H", len(indices), FOREVER, *indices))

    def image(self, half: int, index: int, upload: bytes) -> None:
        """One 24-bit image for one of the controllers."""
        assert len(upload) > HEADER_BYTES
        self.link.write(IMAGE_BEGIN[half], struct.pack("<HI", index, len(upload)))
        for begin in range(0, len(upload), PART_BYTES):
            part = upload[begin : begin + PART_BYTES]
            self.link.write(IMAGE_PART[half], struct.pack("<H", len(part)) + part)

    def trigger_out(self, number: int, trigger: TriggerOut) -> None:
        """Set TRIG_OUT_1 or 2."""
        self.link.write(TRIGGER_OUT[number - 1], trigger.pack())

    def close(self) -> None:
        self.link.close()


def _version(reply: bytes) -> tuple[int, int, int]:
    """Of the application: major u8, minor u8, patch u16, most significant first."""
    (word,) = struct.unpack_from("<I", reply)
    return word >> 24, word >> 16 & 0xFF, word & 0xFFFF
