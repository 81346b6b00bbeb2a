"""A DLPC900 controller as it answers on the wire: 64-byte reports in, reports and light out.

Written from TI's programmer's guide DLPU018 (commands, error codes) and datasheet DLPS037, independently of
the driver. It checks what the device checks, NACKs with the device's codes, and rebuilds every pattern it
was sent, so that a driver is proven by the pictures that come out. No byte of it has met real firmware.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from endo3d.services.devices.emulated.dlpc900_images import BadImage, bit_plane, decode_words

REPORT_BYTES = 64
COMMAND_BUFFER_BYTES = 512
LUT_ENTRIES = 400
IMAGES = 18
MINIMUM_EXPOSURE_US = (105, 304, 394, 823, 1215, 1487, 1998, 4046)
"""For 1..8 bits, as this emulated board reports them; only the first and the last are documented."""
MINIMUM_DARK_US = 105


class Code(IntEnum):
    """The error register, 0100 (DLPU018)."""

    OK = 0
    DEVICE_FAILURE = 2
    BAD_COMMAND = 3
    NOT_ALLOWED_IN_MODE = 5
    BAD_PARAMETER = 6
    NOT_PRESENT = 7
    COMPRESSION = 9
    BIT_NUMBER = 10
    IMAGE_MISSING = 11
    DARK_TIME = 12
    SIGNAL_DELAY = 13
    EXPOSURE = 14
    PATTERN_NUMBER = 15
    BAD_DEFINITION = 16
    MEMORY_ADDRESS = 17


class Nack(Exception):
    """The device refuses a command."""

    def __init__(self, code: Code) -> None:
        super().__init__(code.name)
        self.code = code


DMDS = {1: ("DLP6500", 1920, 1080, 1), 2: ("DLP9000", 2560, 1600, 2)}
"""Name, width, height, controllers."""
Where = tuple[int, int]
"""Controller (0 primary, 1 secondary) and image index."""
ON_THE_FLY = 3
STOPPED, PAUSED, RUNNING = 0, 1, 2


@dataclass(frozen=True, slots=True)
class LutEntry:
    """One pattern definition (1A34)."""

    exposure_us: int
    dark_us: int
    depth: int
    led: int
    clear: bool
    waits_for_trigger: bool
    trigger_2: bool
    image: int
    position: int

    @property
    def where(self) -> tuple[int, int, int]:
        return self.image, self.position, self.depth


@dataclass(frozen=True, slots=True, eq=False)
class ShownPattern:
    """One pattern as it leaves the mirrors."""

    pixels: NDArray[np.uint8]
    """(height, width) grey values, ``depth`` bits."""
    depth: int
    exposure_us: int
    dark_us: int
    trigger_2: bool
    led: int


@dataclass(frozen=True, slots=True)
class Show:
    """What runs after a start: the patterns in order, and how many are shown (0 = for ever)."""

    patterns: tuple[ShownPattern, ...]
    count: int
    trigger_1: tuple[bool, int, int]
    """Inverted, rise us, fall us."""


@dataclass
class Dlpc900:
    """The controller's state; ``receive`` takes one report, ``send`` gives the next one of the reply."""

    dmd: int = 1
    """Its type as command 0206 tells it: 1 = DLP6500, 2 = DLP9000 (a second controller has the right half)."""
    on_show: Callable[[Show], None] = lambda show: None
    on_dark: Callable[[], None] = lambda: None

    error: Code = Code.OK
    power: int = 0
    display_mode: int = 0
    run: int = STOPPED
    definitions: dict[int, LutEntry] = field(default_factory=dict)
    lut: tuple[LutEntry, ...] = ()
    order: tuple[int, ...] = ()
    shown_count: int = 0
    images: dict[Where, bytearray] = field(default_factory=dict)
    words: dict[Where, NDArray[np.uint32]] = field(default_factory=dict)
    """What the images hold, decompressed as they came."""
    announced: dict[Where, int] = field(default_factory=dict)
    receiving_image: Where | None = None
    trigger_out: dict[int, tuple[bool, int, int]] = field(default_factory=lambda: {1: (False, 0, 0), 2: (False, 0, 0)})
    trigger_in: dict[int, tuple[int, int]] = field(default_factory=lambda: {1: (105, 0), 2: (0, 0)})
    idle_mirrors: bool = False
    pwm_polarity: int = 0
    faults: int = 0
    """Fault bits of the hardware status, set by tests."""
    uploads: int = 0
    """Images received since power-up: a mode switch must not raise it."""

    _incoming: bytearray = field(default_factory=bytearray)
    _missing: int = 0
    _replies: deque[bytes] = field(default_factory=deque)

    @property
    def width(self) -> int:
        return DMDS[self.dmd][1]

    @property
    def height(self) -> int:
        return DMDS[self.dmd][2]

    @property
    def controllers(self) -> int:
        return DMDS[self.dmd][3]

    def receive(self, report: bytes) -> None:
        """One 64-byte OUT report: the head of a message or its continuation."""
        if len(report) != REPORT_BYTES:
            self.error = Code.DEVICE_FAILURE
            return
        if not self._missing:
            (length,) = struct.unpack_from("<H", report, 2)
            self._incoming = bytearray()
            self._missing = 4 + length
        taken = report[: self._missing]
        self._incoming += taken
        self._missing -= len(taken)
        if not self._missing:
            self._execute(bytes(self._incoming))

    def send(self) -> bytes | None:
        """The next IN report, or nothing yet."""
        return self._replies.popleft() if self._replies else None

    def _execute(self, message: bytes) -> None:
        flag, sequence, length = struct.unpack_from("<BBH", message)
        reads, wants_reply = bool(flag & 0x80), bool(flag & 0x40)
        answer = b""
        nack = 0
        try:
            if length < 2 or len(message) > COMMAND_BUFFER_BYTES or flag & 0x07:
                raise Nack(Code.BAD_COMMAND)
            (command,) = struct.unpack_from("<H", message, 4)
            if reads:
                answer = self._read(command)
                if command == 0x0100:
                    self.error = Code.OK
            else:
                self._write(command, message[6:])
                self.error = Code.OK
        except Nack as refusal:
            self.error, nack = refusal.code, 0x20
        except struct.error:
            self.error, nack = Code.BAD_PARAMETER, 0x20
        except BadImage as bad:
            self.error, nack = Code(bad.code), 0x20
        if reads or wants_reply:
            reply = struct.pack("<BBH", (flag & 0xC0) | nack, sequence, len(answer)) + answer
            for start in range(0, len(reply), REPORT_BYTES):
                self._replies.append(reply[start : start + REPORT_BYTES].ljust(REPORT_BYTES, b"\0"))

    def _read(self, command: int) -> bytes:
        match command:
            case 0x0100:
                return bytes([self.error])
            case 0x0101:
                return self.error.name.replace("_", " ").lower().encode().ljust(128, b"\0")
            case 0x0205:
                return struct.pack("<4I", 0x06000000, 0x06000000, 0x06000000, 0x06000000)
            case 0x0206:
                return bytes([self.dmd]) + f"endo3d emulated {DMDS[self.dmd][0]}".encode().ljust(31, b"\0")
            case 0x1A0A:
                return bytes([0x01 | (self.controllers == 2) << 4 | self.faults])
            case 0x1A0B:
                return b"\x01"
            case 0x1A0C:
                return bytes([(self.power == 1) | (self.run == RUNNING) << 1])
            case 0x1A1B:
                return bytes([self.display_mode])
            case 0x1A42:
                return struct.pack("<8H", *MINIMUM_EXPOSURE_US)
            case _:
                raise Nack(Code.BAD_COMMAND)

    def _write(self, command: int, data: bytes) -> None:
        match command:
            case 0x0200:
                self._set_power(*struct.unpack_from("<B", data))
            case 0x0201:
                self.idle_mirrors = bool(struct.unpack_from("<B", data)[0])
            case 0x1A1B:
                self._set_display_mode(*struct.unpack_from("<B", data))
            case 0x1A24:
                self._set_run(*struct.unpack_from("<B", data))
            case 0x1A34:
                self._define(data)
            case 0x1A31:
                self._configure(*struct.unpack_from("<HI", data))
            case 0x1A32:
                self._reorder(data)
            case 0x1A2A | 0x1A2C:
                self._announce_image((command - 0x1A2A) // 2, *struct.unpack_from("<HI", data))
            case 0x1A2B | 0x1A2D:
                self._receive_image((command - 0x1A2B) // 2, data)
            case 0x1A1D | 0x1A1E:
                self._set_trigger_out(command - 0x1A1C, *struct.unpack_from("<Bhh", data))
            case 0x1A35:
                delay, edge = struct.unpack_from("<HB", data)
                self.trigger_in[1] = (delay, edge)
            case 0x1A36:
                self.trigger_in[2] = (0, *struct.unpack_from("<B", data))
            case 0x1A05:
                (self.pwm_polarity,) = struct.unpack_from("<B", data)
            case _:
                raise Nack(Code.BAD_COMMAND)

    def _set_power(self, mode: int) -> None:
        if mode > 2:
            raise Nack(Code.BAD_PARAMETER)
        if mode == 2:
            self.__init__(self.dmd, self.on_show, self.on_dark)  # type: ignore[misc]
        self.power = mode % 2
        self.on_dark()

    def _needs_standstill(self) -> None:
        if self.run != STOPPED:
            raise Nack(Code.NOT_ALLOWED_IN_MODE)

    def _needs_on_the_fly(self) -> None:
        if self.display_mode != ON_THE_FLY:
            raise Nack(Code.NOT_ALLOWED_IN_MODE)

    def _set_display_mode(self, mode: int) -> None:
        self._needs_standstill()
        if mode > 3:
            raise Nack(Code.BAD_PARAMETER)
        if mode != self.display_mode:
            self.definitions, self.lut, self.order = {}, (), ()
            self.images, self.announced, self.words, self.receiving_image = {}, {}, {}, None
        self.display_mode = mode

    def _define(self, data: bytes) -> None:
        """1A34: index u16, exposure u24, flags, dark u24, triggers, image and bit position u16."""
        self._needs_on_the_fly()
        self._needs_standstill()
        if len(data) < 12:
            raise Nack(Code.BAD_PARAMETER)
        index = int.from_bytes(data[0:2], "little")
        exposure_us = int.from_bytes(data[2:5], "little")
        flags = data[5]
        dark_us = int.from_bytes(data[6:9], "little")
        where = int.from_bytes(data[10:12], "little")
        depth = (flags >> 1 & 0x7) + 1
        entry = LutEntry(
            exposure_us=exposure_us,
            dark_us=dark_us,
            depth=depth,
            led=flags >> 4 & 0x7,
            clear=bool(flags & 1),
            waits_for_trigger=bool(flags & 0x80),
            trigger_2=not data[9] & 1,
            image=where & 0x7FF,
            position=where >> 11,
        )
        if index >= LUT_ENTRIES:
            raise Nack(Code.PATTERN_NUMBER)
        if entry.image >= IMAGES:
            raise Nack(Code.IMAGE_MISSING)
        if entry.position + depth > 24:
            raise Nack(Code.BIT_NUMBER)
        if exposure_us < MINIMUM_EXPOSURE_US[depth - 1]:
            raise Nack(Code.EXPOSURE)
        if dark_us and dark_us < MINIMUM_DARK_US:
            raise Nack(Code.DARK_TIME)
        self.definitions[index] = entry

    def _configure(self, entries: int, shown: int) -> None:
        """1A31: how many of the definitions make the table, and how many patterns are shown."""
        self._needs_on_the_fly()
        self._needs_standstill()
        if not 1 <= entries <= LUT_ENTRIES:
            raise Nack(Code.PATTERN_NUMBER)
        if any(index not in self.definitions for index in range(entries)):
            raise Nack(Code.BAD_DEFINITION)
        before, self.lut = self.lut, tuple(self.definitions[index] for index in range(entries))
        if [entry.where for entry in self.lut] != [entry.where for entry in before]:
            self.images, self.announced, self.words = {}, {}, {}  # a change of count, depth or index needs a new upload
        self.order = tuple(range(entries))
        self.shown_count = shown

    def _reorder(self, data: bytes) -> None:
        """1A32: shows a subset of the loaded patterns, in any order, without a new upload."""
        self._needs_on_the_fly()
        self._needs_standstill()
        entries, shown = struct.unpack_from("<HI", data)
        order = struct.unpack_from(f"<{entries}H", data, 6)
        if not order or any(index >= len(self.lut) for index in order):
            raise Nack(Code.PATTERN_NUMBER)
        self.order, self.shown_count = order, shown

    def _announce_image(self, controller: int, index: int, size: int) -> None:
        self._needs_on_the_fly()
        self._needs_standstill()
        if controller >= self.controllers:
            raise Nack(Code.NOT_PRESENT)
        if index >= IMAGES:
            raise Nack(Code.MEMORY_ADDRESS)
        self.receiving_image = where = controller, index
        self.images[where], self.announced[where] = bytearray(), size
        self.words.pop(where, None)

    def _receive_image(self, controller: int, data: bytes) -> None:
        where = self.receiving_image
        if where is None or where[0] != controller:
            raise Nack(Code.IMAGE_MISSING)
        (count,) = struct.unpack_from("<H", data)
        if count > 504 or len(data) < 2 + count:
            raise Nack(Code.BAD_PARAMETER)
        image = self.images[where]
        image += data[2 : 2 + count]
        if len(image) > self.announced[where]:
            raise Nack(Code.MEMORY_ADDRESS)
        if len(image) == self.announced[where]:
            self.uploads += 1
            self.receiving_image = None
            self.words[where] = decode_words(bytes(image))

    def _set_trigger_out(self, output: int, inverted: int, rise_us: int, fall_us: int) -> None:
        if not (-20 <= rise_us <= 20_000 and -20 <= fall_us <= 20_000):
            raise Nack(Code.SIGNAL_DELAY)
        self.trigger_out[output] = (bool(inverted), rise_us, fall_us)

    def _set_run(self, run: int) -> None:
        if run > 2:
            raise Nack(Code.BAD_PARAMETER)
        if run == RUNNING:
            self._needs_on_the_fly()
            if not self.order:
                raise Nack(Code.BAD_DEFINITION)
            show = self.show()
            self.run = RUNNING
            self.on_show(show)
        else:
            self.run = run
            self.on_dark()

    def show(self) -> Show:
        """The patterns as the mirrors will show them, rebuilt from what was uploaded."""
        words: dict[int, NDArray[np.uint32]] = {}
        patterns = []
        for entry in (self.lut[index] for index in self.order):
            if entry.image not in words:
                words[entry.image] = self._image_words(entry.image)
            pixels = bit_plane(words[entry.image], entry.position, entry.depth)
            patterns.append(
                ShownPattern(pixels, entry.depth, entry.exposure_us, entry.dark_us, entry.trigger_2, entry.led)
            )
        return Show(tuple(patterns), self.shown_count, self.trigger_out[1])

    def _image_words(self, index: int) -> NDArray[np.uint32]:
        return np.hstack([self._half_words((controller, index)) for controller in range(self.controllers)])

    def _half_words(self, where: Where) -> NDArray[np.uint32]:
        words = self.words.get(where)
        if words is None or words.shape != (self.height, self.width // self.controllers):
            raise Nack(Code.IMAGE_MISSING)
        return words
