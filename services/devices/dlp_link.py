"""The wire of TI's DLP controllers (DLPC900, DLPC350): commands in 64-byte HID reports over pyusb.

A message, little-endian, zero-padded to whole reports: flag u8 | sequence u8 | length u16 | command u16 |
payload; length counts command and payload. A reply has no command: flag | sequence | length u16 | payload.
Source: TI DLPU018 (DLPC900) and DLPU010 (DLPC350), USB interface.
"""

from __future__ import annotations

import errno
import struct
from collections.abc import Callable
from typing import Any, TypeVar

import usb.core
import usb.util

from endo3d.services.devices.uri import DeviceError

VENDOR = 0x0451
REPORT_BYTES = 64
OUT, IN = 0x01, 0x81
INTERFACE = 0
TIMEOUT_MS = 500
DRAIN_MS = 20
ATTEMPTS = 4
STALE = 16
"""Reports of other exchanges that are read past before an exchange counts as failed."""

READ, ACKNOWLEDGED_WRITE, POSTED_WRITE = 0xC0, 0x40, 0x00
NACK = 0x20
HEADER = struct.Struct("<BBH")
COMMAND = struct.Struct("<H")
FIRST_PAYLOAD_BYTES = REPORT_BYTES - HEADER.size - COMMAND.size

ERROR_CODE, ERROR_TEXT = 0x0100, 0x0101
ERRORS = {
    1: "batch file checksum", 2: "device failure", 3: "bad command", 4: "incompatible DMD",
    5: "not allowed in this mode", 6: "bad parameter", 7: "not present", 8: "out of resources",
    9: "BMP compression", 10: "BMP bit number", 11: "BMP missing", 12: "dark time", 13: "signal delay",
    14: "exposure time", 15: "pattern number", 16: "bad pattern definition", 17: "memory address",
    255: "internal error",
}  # fmt: skip


T = TypeVar("T")


class DeviceGone(DeviceError):
    """Nothing is plugged in, or not any more."""


class Rejected(DeviceError):
    """The device understood a command and refused it."""

    def __init__(self, command: int, code: int, text: str) -> None:
        reason = ERRORS.get(code, "unknown error")
        said = f": {text}" if text and text.casefold() != reason else ""
        super().__init__(f"the projector refused command {command:04X} with error {code}, {reason}{said}")
        self.command, self.code = command, code


class BadReply(Exception):
    """What came back is no answer to what was asked."""


def messages(flag: int, sequence: int, command: int, payload: bytes) -> list[bytes]:
    """The reports of one message, each of 64 bytes."""
    message = HEADER.pack(flag, sequence, COMMAND.size + len(payload)) + COMMAND.pack(command) + payload
    padded = message.ljust(-(-len(message) // REPORT_BYTES) * REPORT_BYTES, b"\0")
    return [padded[i : i + REPORT_BYTES] for i in range(0, len(padded), REPORT_BYTES)]


class Link:
    """One controller. Exchanges that fail are repeated; after ``DeviceGone`` it has to be opened anew."""

    def __init__(self, find: Callable[[], Any], name: str) -> None:
        """``find`` returns a pyusb device or None. Raises ``DeviceGone`` or ``DeviceError``."""
        self.name = name
        self.retries = 0
        """Exchanges that had to be repeated."""
        self._sequence = 0
        try:
            self._device = find()
        except usb.core.NoBackendError:
            raise DeviceError("libusb is not installed; apt install libusb-1.0-0") from None
        if self._device is None:
            raise DeviceGone(f"no {name} on USB; plug it in, switch it on, and see `endo3d devices`")
        try:
            if self._device.is_kernel_driver_active(INTERFACE):
                self._device.detach_kernel_driver(INTERFACE)
            usb.util.claim_interface(self._device, INTERFACE)
        except NotImplementedError:
            usb.util.claim_interface(self._device, INTERFACE)  # a system without kernel drivers to detach
        except usb.core.USBError as error:
            usb.util.dispose_resources(self._device)
            raise self._lost(error) from error
        self._drain()

    def read(self, command: int, payload: bytes = b"") -> bytes:
        """Ask. Raises ``Rejected``, ``DeviceGone`` or ``DeviceError``."""
        return self._repeated(command, lambda: self._ask(READ, command, payload))

    def write(self, command: int, payload: bytes = b"") -> None:
        """Command, and wait until the device has accepted it. Raises like ``read``."""
        if len(payload) <= FIRST_PAYLOAD_BYTES:
            self._repeated(command, lambda: self._ask(ACKNOWLEDGED_WRITE, command, payload))
            return
        # The device acknowledges no message of several reports: it is asked for its error afterwards.
        for report in messages(POSTED_WRITE, self._next(), command, payload):
            self._repeated(command, lambda report=report: self._send(report))  # type: ignore[misc]
        code = self.read(ERROR_CODE)[0]
        if code:
            raise Rejected(command, code, self._error_text())

    def close(self) -> None:
        """Give the interface back. Never raises."""
        try:
            usb.util.release_interface(self._device, INTERFACE)
        except usb.core.USBError:
            pass  # it is gone already
        finally:
            usb.util.dispose_resources(self._device)

    def _repeated(self, command: int, exchange: Callable[[], T]) -> T:
        """An exchange, again if it failed on the way: all commands may be given twice.

        A report that timed out or stalled was not taken by the device (USB's own handshake says so): a message
        of several reports goes on with the report that failed.
        """
        failure: Exception
        for attempt in range(ATTEMPTS):
            self.retries += attempt > 0
            try:
                return exchange()
            except BadReply as error:
                failure = error
                self._drain()
            except usb.core.USBError as error:
                if error.errno not in (errno.ETIMEDOUT, errno.EPIPE):
                    raise self._lost(error) from error
                failure = error
                self._recover(error)
        raise DeviceError(
            f"the {self.name} does not answer command {command:04X} ({failure}); "
            "switch it off and on, and try another cable"
        )

    def _ask(self, flag: int, command: int, payload: bytes) -> bytes:
        sequence = self._next()
        (report,) = messages(flag, sequence, command, payload)
        self._send(report)
        for _ in range(STALE):
            answer_flag, answered, answer = self._receive()
            if answered != sequence:
                continue
            if not answer_flag & NACK:
                return answer
            if command in (ERROR_CODE, ERROR_TEXT):
                raise Rejected(command, 255, "")
            code = self._ask(READ, ERROR_CODE, b"")[0]
            raise Rejected(command, code, self._error_text())
        raise BadReply("only answers to other questions")

    def _error_text(self) -> str:
        text = self.read(ERROR_TEXT).partition(b"\0")[0]
        return text.decode("ascii", "replace").strip()

    def _receive(self) -> tuple[int, int, bytes]:
        """One reply: flag, sequence, payload."""
        report = self._report()
        flag, sequence, length = HEADER.unpack_from(report)
        reply = report[HEADER.size :]
        while len(reply) < length:
            reply += self._report()
        return flag, sequence, reply[:length]

    def _report(self) -> bytes:
        report = bytes(self._device.read(IN, REPORT_BYTES, TIMEOUT_MS))
        if len(report) != REPORT_BYTES:
            raise BadReply(f"a report of {len(report)} bytes")
        return report

    def _send(self, report: bytes) -> None:
        if self._device.write(OUT, report, TIMEOUT_MS) != REPORT_BYTES:
            raise BadReply("a report was cut short")

    def _next(self) -> int:
        self._sequence = (self._sequence + 1) % 256
        return self._sequence

    def _drain(self) -> None:
        """Read away what is left of earlier exchanges."""
        try:
            for _ in range(STALE):
                self._device.read(IN, REPORT_BYTES, DRAIN_MS)
        except usb.core.USBError as error:
            if error.errno not in (errno.ETIMEDOUT, errno.EPIPE):
                raise self._lost(error) from error
            self._recover(error)

    def _recover(self, error: usb.core.USBError) -> None:
        if error.errno == errno.EPIPE:
            for endpoint in (OUT, IN):
                self._device.clear_halt(endpoint)

    def _lost(self, error: usb.core.USBError) -> DeviceError:
        if error.errno in (errno.EACCES, errno.EPERM):
            return DeviceError(
                f"no permission for the {self.name}; copy deploy/udev/70-endo3d.rules to /etc/udev/rules.d, "
                "run `udevadm control --reload`, and plug it in again"
            )
        if error.errno == errno.EBUSY:
            return DeviceError(f"the {self.name} is used by another program; end that one first")
        return DeviceGone(f"the {self.name} was unplugged or lost its power; plug it in again ({error})")
