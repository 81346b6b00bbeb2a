"""The DLPC350 driver's bytes against TI's DLPU010; there is no emulator of it, only a wire that says yes."""

from __future__ import annotations

import struct

import pytest
import usb.core

from endo3d.services.devices.dlpc350_projector import Dlpc350Projector, lut_entry
from endo3d.services.devices.emulated.usb_port import UsbPort
from endo3d.services.devices.uri import DeviceError
from endo3d_core import patterns

INTERLEAVED = patterns.parse("interleaved f1=25")
VALIDATE = 0x1A1A


class Willing:
    """Acknowledges every command and answers reads with one byte; keeps what it was sent."""

    def __init__(self) -> None:
        self.sent: list[tuple[int, bytes]] = []
        self.answers: dict[int, int] = {}
        self._replies: list[bytes] = []

    def receive(self, report: bytes) -> None:
        flag, sequence, length = struct.unpack_from("<BBH", report)
        (command,) = struct.unpack_from("<H", report, 4)
        if flag & 0x80:
            reply = struct.pack("<BBHB", 0xC0, sequence, 1, self.answers.get(command, 0))
        else:
            self.sent.append((command, report[6 : 4 + length]))
            reply = struct.pack("<BBH", 0x40, sequence, 0)
        self._replies.append(reply.ljust(64, b"\0"))

    def send(self) -> bytes | None:
        return self._replies.pop(0) if self._replies else None

    def on_dark(self) -> None: ...


@pytest.fixture
def device() -> Willing:
    return Willing()


@pytest.fixture
def projector(device: Willing) -> Dlpc350Projector:
    port = UsbPort(device)  # type: ignore[arg-type]
    made = Dlpc350Projector(lambda: usb.core.find(backend=port), first_image=2, led=7)
    made.load([INTERLEAVED])
    device.sent.clear()
    return made


def test_three_bytes_per_entry() -> None:
    """Internal trigger, pattern 0, 8 bits, white, buffer swap; the next pattern of the same image goes on."""
    assert lut_entry(0, 8, 7, swap=True, first=True) == bytes([0b01, 0x78, 0b0100])
    assert lut_entry(2, 8, 7, swap=False, first=False) == bytes([0b1011, 0x78, 0])


def test_the_order_of_commands(projector: Dlpc350Projector, device: Willing) -> None:
    projector.start(INTERLEAVED, 8400.0, 300.0)
    entries = b"".join(
        lut_entry(number, 8, 7, swap=swap, first=first)
        for number, swap, first in ((0, True, True), (1, False, False), (2, False, False), (0, True, False))
    )
    assert device.sent == [
        (0x1A24, b"\0"),
        (0x1A1B, b"\1"),
        (0x1A22, b"\3"),
        (0x1A31, bytes([3, 1, 3, 1])),
        (0x1A23, b"\1"),
        (0x1A29, struct.pack("<II", 8400, 8700)),
        (0x1A33, b"\2"), (0x1A32, b"\0"), (0x1A34, entries), (0x1A33, b"\0"),
        (0x1A33, b"\1"), (0x1A32, b"\0"), (0x1A34, bytes([2, 3])), (0x1A33, b"\0"),
        (VALIDATE, b"\0"),
        (0x1A24, b"\2"),
    ]  # fmt: skip


def test_what_the_device_calls_invalid_is_told(projector: Dlpc350Projector, device: Willing) -> None:
    device.answers[VALIDATE] = 0x10
    with pytest.raises(DeviceError, match="differ by less than 230 us"):
        projector.start(INTERLEAVED, 8400.0, 300.0)


@pytest.mark.parametrize(("exposure_us", "dark_us"), [(8332.0, 300.0), (8400.0, 229.0)])
def test_times_too_short_are_refused(projector: Dlpc350Projector, exposure_us: float, dark_us: float) -> None:
    with pytest.raises(DeviceError, match=r"8333|230"):
        projector.start(INTERLEAVED, exposure_us, dark_us)


def test_no_dark_time_is_possible(projector: Dlpc350Projector, device: Willing) -> None:
    projector.start(INTERLEAVED, 8400.0, 0.0)
    assert (0x1A29, struct.pack("<II", 8400, 8400)) in device.sent
