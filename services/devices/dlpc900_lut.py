"""The DLPC900's pattern look-up table: one 12-byte entry per pattern (command 1A34).

Source: TI DLPU018, pattern display LUT definition.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from endo3d.services.devices.dlpc900_image import Place

ENTRIES = 400
WHITE = 7
ENTRY = struct.Struct("<H3sB3sBH")
LONGEST_US = 0xFFFFFF
"""Exposure and dark time are 24-bit numbers."""


@dataclass(frozen=True, slots=True)
class Entry:
    place: Place
    exposure_us: int
    dark_us: int
    index_pulse: bool
    """Whether TRIG_OUT_2 fires: at the first pattern of a set only."""
    led: int = WHITE
    clear: bool = False
    """Black the mirrors after the exposure, also without a dark time."""
    wait_for_trigger: bool = False

    def pack(self, index: int) -> bytes:
        """12 bytes: index u16, exposure u24, depth and LED, dark u24, triggers, image and bit position."""
        kind = (
            self.clear | (self.place.depth - 1) << 1 | self.led << 4 | self.wait_for_trigger << 7
        )  # fmt: skip
        return ENTRY.pack(
            index,
            self.exposure_us.to_bytes(3, "little"),
            kind,
            self.dark_us.to_bytes(3, "little"),
            not self.index_pulse,  # bit 0 set DISABLES TRIG_OUT_2
            self.place.image | self.place.bit << 11,
        )
