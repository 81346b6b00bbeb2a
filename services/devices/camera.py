"""What a camera is to the stack."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import DTypeLike, NDArray

from endo3d.services.devices.uri import Setting, open_device

DRIVERS = ("sim", "aravis", "uvc", "gentl", "folder", "log")


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """One exposure, in memory that was lent to the camera."""

    image: NDArray[Any]
    """The lent array itself, filled."""
    trigger_ns: int
    """Start of exposure, translated to the rig's clock."""
    frame_id: int
    """The camera's own count: contiguous although triggers were missed, a gap is a loss in transport."""
    exposure_us: float


class Camera(Protocol):
    """Arms once, fills lent arrays in order. Calls come from one thread."""

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of the images."""

    @property
    def dtype(self) -> DTypeLike:
        """uint8 or uint16."""

    @property
    def corner(self) -> tuple[int, int]:
        """(x, y) of the images' first pixel on the sensor, in their own pixels: a region starts elsewhere than 0, 0."""

    @property
    def bin_px(self) -> int | None:
        """Sensor pixels per image pixel; None where the driver can't know."""

    def arm(self) -> None:
        """Be ready for triggers; what was exposed before is discarded."""

    def lend(self, image: NDArray[Any]) -> None:
        """Give the camera an array of ``shape`` and ``dtype`` to fill; it comes back in a ``Shot``."""

    def wait(self, timeout_s: float) -> Shot | None:
        """The next shot; None when there was none in time. Raises ``DeviceError`` when the camera is gone."""

    def set_exposure(self, exposure_us: float) -> None:
        """The longest the projector shows a pattern: the camera integrates all of it."""

    def now_ns(self) -> int:
        """The rig's clock, as this camera's stamps are given in."""

    def losses(self) -> dict[str, int]:
        """What was lost since arming, per cause: ``underrun`` (nothing lent), ``transport``."""

    def close(self) -> None:
        """Disarm and let go; lent arrays are no longer touched."""


@runtime_checkable
class Simulated(Protocol):
    """A camera that knows the truth."""

    scene: str
    slow_motion: float

    def T_scene_camera(self, stamp_ns: int) -> NDArray[np.float64]:
        """(4, 4) mm at a time of the rig's clock."""


def open_camera(uri: str, setting: Setting) -> Camera:
    """Open by URI. Raises ``DeviceError`` with what to do."""
    camera: Camera = open_device(uri, "camera", DRIVERS, setting)
    return camera
