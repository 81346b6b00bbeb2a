"""A USB port for pyusb with an emulated DLPC900 plugged in: ``usb.core.find(..., backend=port)``.

The port can fail on command, as cables and hosts do: time out, stall, unplug, cut a reply short, or answer
with a stale sequence number. Where a file stands for the cable, somebody in another process can pull it.
"""

from __future__ import annotations

import errno
from array import array
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import usb.backend
import usb.core

from endo3d.services.devices.emulated.dlpc900 import REPORT_BYTES, Dlpc900

VENDOR, PRODUCT = 0x0451, 0xC900
ENDPOINT_OUT, ENDPOINT_IN = 0x01, 0x81

Fault = Literal["timeout", "stall", "unplug", "short read", "wrong sequence"]


class UsbPort(usb.backend.IBackend):  # type: ignore[misc]
    """A pyusb backend with one HID interface, 64-byte interrupt endpoints, and one device or none."""

    def __init__(self, device: Dlpc900 | None = None, cable: Path | None = None) -> None:
        """``cable``: a file; the device is plugged in while it exists."""
        self.device = device or Dlpc900()
        self._cable = cable
        self.plugged = True
        self.kernel_driver = True
        """usbhid holds the interface, as on a real Linux host, until it is detached."""
        self.claimed = False
        self.reports: list[bytes] = []
        """Every OUT report that arrived, for tests of the wire itself."""
        self._faults: deque[Fault] = deque()

    def fail_next(self, *faults: Fault) -> None:
        """The next transfers that can fail this way do."""
        self._faults.extend(faults)

    def unplug(self) -> None:
        self.plugged = False
        self.claimed = False
        self.device.on_dark()

    def plug_in(self) -> None:
        """The device comes back as after power-up: it has forgotten everything."""
        old = self.device
        self.device = Dlpc900(old.dmd, old.on_show, old.on_dark)
        self.plugged = True
        self.kernel_driver = True

    def enumerate_devices(self) -> Iterator[object]:
        self._follow_cable()
        return iter((self,) if self.plugged else ())

    def get_parent(self, dev: object) -> None:
        return None

    def get_device_descriptor(self, dev: object) -> SimpleNamespace:
        return SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=0x0110, bDeviceClass=0, bDeviceSubClass=0,
            bDeviceProtocol=0, bMaxPacketSize0=64, idVendor=VENDOR, idProduct=PRODUCT, bcdDevice=0x0100,
            iManufacturer=0, iProduct=0, iSerialNumber=0, bNumConfigurations=1, address=1, bus=1,
            port_number=1, port_numbers=(1,), speed=2,
        )  # fmt: skip

    def get_configuration_descriptor(self, dev: object, config: int) -> SimpleNamespace:
        if config != 0:
            raise IndexError(config)
        return SimpleNamespace(
            bLength=9, bDescriptorType=2, wTotalLength=41, bNumInterfaces=1, bConfigurationValue=1,
            iConfiguration=0, bmAttributes=0xC0, bMaxPower=0, extra_descriptors=[],
        )  # fmt: skip

    def get_interface_descriptor(self, dev: object, intf: int, alt: int, config: int) -> SimpleNamespace:
        if intf != 0 or alt != 0:
            raise IndexError((intf, alt))
        return SimpleNamespace(
            bLength=9, bDescriptorType=4, bInterfaceNumber=0, bAlternateSetting=0, bNumEndpoints=2,
            bInterfaceClass=3, bInterfaceSubClass=0, bInterfaceProtocol=0, iInterface=0, extra_descriptors=[],
        )  # fmt: skip

    def get_endpoint_descriptor(self, dev: object, ep: int, intf: int, alt: int, config: int) -> SimpleNamespace:
        return SimpleNamespace(
            bLength=7, bDescriptorType=5, bEndpointAddress=(ENDPOINT_OUT, ENDPOINT_IN)[ep], bmAttributes=3,
            wMaxPacketSize=REPORT_BYTES, bInterval=1, bRefresh=0, bSynchAddress=0, extra_descriptors=[],
        )  # fmt: skip

    def open_device(self, dev: object) -> object:
        self._needs_cable()
        return self

    def close_device(self, dev_handle: object) -> None:
        self.claimed = False

    def get_configuration(self, dev_handle: object) -> int:
        self._needs_cable()
        return 1

    def set_configuration(self, dev_handle: object, config_value: int) -> None:
        self._needs_cable()
        if self.kernel_driver:
            raise usb.core.USBError("Resource busy", errno=errno.EBUSY)

    def set_interface_altsetting(self, dev_handle: object, intf: int, altsetting: int) -> None:
        self._needs_cable()

    def claim_interface(self, dev_handle: object, intf: int) -> None:
        self._needs_cable()
        if self.kernel_driver:
            raise usb.core.USBError("Resource busy", errno=errno.EBUSY)
        self.claimed = True

    def release_interface(self, dev_handle: object, intf: int) -> None:
        self.claimed = False

    def is_kernel_driver_active(self, dev_handle: object, intf: int) -> bool:
        return self.kernel_driver

    def detach_kernel_driver(self, dev_handle: object, intf: int) -> None:
        self.kernel_driver = False

    def attach_kernel_driver(self, dev_handle: object, intf: int) -> None:
        self.kernel_driver = True

    def clear_halt(self, dev_handle: object, ep: int) -> None:
        self._needs_cable()

    def reset_device(self, dev_handle: object) -> None:
        self._needs_cable()

    def intr_write(self, dev_handle: object, ep: int, intf: int, data: Any, timeout: int) -> int:
        self._needs_claim()
        self._fail("timeout", "stall", "unplug")
        report = bytes(data)
        self.reports.append(report)
        self.device.receive(report)
        return len(report)

    def intr_read(self, dev_handle: object, ep: int, intf: int, buff: array[int], timeout: int) -> int:
        self._needs_claim()
        self._fail("timeout", "stall", "unplug")
        report = self.device.send()
        if report is None:
            raise usb.core.USBTimeoutError("Operation timed out", errno=errno.ETIMEDOUT)
        if self._take("wrong sequence"):
            report = report[:1] + bytes([report[1] ^ 0x55]) + report[2:]
        if self._take("short read"):
            report = report[:3]
        buff[: len(report)] = array("B", report)
        return len(report)

    def _follow_cable(self) -> None:
        if self._cable is None or self._cable.exists() == self.plugged:
            return
        if self.plugged:
            self.unplug()
        else:
            self.plug_in()

    def _needs_cable(self) -> None:
        self._follow_cable()
        if not self.plugged:
            raise usb.core.USBError("No such device (it may have been disconnected)", errno=errno.ENODEV)

    def _needs_claim(self) -> None:
        self._needs_cable()
        if not self.claimed:
            raise usb.core.USBError("Interface not claimed", errno=errno.EIO)

    def _take(self, fault: Fault) -> bool:
        if self._faults and self._faults[0] == fault:
            self._faults.popleft()
            return True
        return False

    def _fail(self, *faults: Fault) -> None:
        for fault in faults:
            if not self._take(fault):
                continue
            if fault == "timeout":
                raise usb.core.USBTimeoutError("Operation timed out", errno=errno.ETIMEDOUT)
            if fault == "stall":
                raise usb.core.USBError("Pipe error", errno=errno.EPIPE)
            self.unplug()
            self._needs_cable()
