"""The DLPC900 driver on an emulated USB port."""

from __future__ import annotations

from collections.abc import Callable

import usb.core

from endo3d.services.devices.dlp_link import VENDOR
from endo3d.services.devices.dlpc900_controller import PRODUCT
from endo3d.services.devices.dlpc900_projector import Dlpc900Projector
from endo3d.services.devices.emulated.dlpc900 import Dlpc900, Show
from endo3d.services.devices.emulated.usb_port import UsbPort

WINDOW = (960, 960)


class Plugged:
    """A driver on an emulated USB port, and what came out of it."""

    def __init__(self, dmd: int = 1) -> None:
        self.shows: list[Show] = []
        self.port = UsbPort(Dlpc900(dmd, self.shows.append))
        self.projector = Dlpc900Projector(self.find, WINDOW)

    def find(self) -> object:
        return usb.core.find(idVendor=VENDOR, idProduct=PRODUCT, backend=self.port)

    def reports_of(self, action: Callable[[], object]) -> list[bytes]:
        """The OUT reports that an action sends."""
        before = len(self.port.reports)
        action()
        return self.port.reports[before:]
