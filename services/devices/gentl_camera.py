"""``gentl:PRODUCER.cti``: any camera with a vendor's GenTL producer, through harvesters (``endo3d[gentl]``).

Without a path the producers of GENICAM_GENTL64_PATH are used. Options: ``id`` (serial number; the first camera by
default), ``trigger`` (``Line0``, ``none``), ``format`` (``Mono8``, ``Mono16``), ``width``, ``height``, ``x``, ``y``.
Written from the GenICam standard's names; no producer was here to try it with.
"""

from __future__ import annotations

import os
import time
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from endo3d.services.devices.camera import Shot
from endo3d.services.devices.camera_clock import CameraClock
from endo3d.services.devices.uri import DeviceError, Setting, Uri

DTYPES: dict[str, type[np.generic]] = {"Mono8": np.uint8, "Mono16": np.uint16}
PATHS = "GENICAM_GENTL64_PATH"


def open_uri(uri: Uri, setting: Setting) -> GentlCamera:
    serial, trigger = uri.text_of("id", ""), uri.text_of("trigger", "Line0")
    pixel_format = uri.text_of("format", "Mono8")
    region = {key: int(uri.number(key, -1)) for key in ("width", "height", "x", "y")}
    uri.finish()
    if pixel_format not in DTYPES:
        raise DeviceError(f"device {uri.text!r}: format is {' or '.join(DTYPES)}")
    producers = [Path(uri.body)] if uri.body else installed_producers()
    if not producers or not all(path.is_file() for path in producers):
        raise DeviceError(
            f"device {uri.text!r}: no GenTL producer; install the camera vendor's and write gentl:/path/to/it.cti, "
            f"or set {PATHS}"
        )
    return GentlCamera(producers, serial, trigger, pixel_format, region)


def installed_producers() -> list[Path]:
    """The .cti files that vendors' packages have announced."""
    folders = [Path(folder) for folder in os.environ.get(PATHS, "").split(os.pathsep) if folder]
    return sorted(path for folder in folders if folder.is_dir() for path in folder.glob("*.cti"))


class GentlCamera:
    """The producer's buffers are copied into the lent arrays."""

    def __init__(
        self, producers: list[Path], serial: str, trigger: str, pixel_format: str, region: dict[str, int]
    ) -> None:
        try:
            from genicam.gentl import TimeoutException
            from harvesters.core import Harvester
        except ImportError:
            raise DeviceError("harvesters is not installed; pip install 'endo3d[gentl]'") from None
        self._timeout = TimeoutException
        self._harvester = Harvester()
        for path in producers:
            self._harvester.add_file(str(path))
        self._harvester.update()
        try:
            self._acquirer = self._harvester.create({"serial_number": serial} if serial else 0)
        except (ValueError, IndexError) as error:
            self._harvester.reset()
            raise DeviceError(f"no camera {serial} at the GenTL producers; plug it in ({error})") from error
        self._nodes = nodes = self._acquirer.remote_device.node_map
        nodes.PixelFormat.value = pixel_format
        for name, key in (("Width", "width"), ("Height", "height"), ("OffsetX", "x"), ("OffsetY", "y")):
            if region[key] >= 0:
                getattr(nodes, name).value = region[key]
        if trigger != "none":
            nodes.TriggerSelector.value = "FrameStart"
            nodes.TriggerSource.value = trigger
            nodes.TriggerActivation.value = "RisingEdge"
        nodes.TriggerMode.value = "Off" if trigger == "none" else "On"
        self.shape: tuple[int, int] = (nodes.Height.value, nodes.Width.value)
        self.corner: tuple[int, int] = (nodes.OffsetX.value, nodes.OffsetY.value)
        self.bin_px: int | None = None
        self._dtype = DTYPES[pixel_format]
        self._clock = CameraClock()
        self._lent: deque[NDArray[Any]] = deque()
        self._exposure_us = 0.0
        self._frame_id = -1
        self._first_id: int | None = None
        self._losses = {"underrun": 0}

    @property
    def dtype(self) -> DTypeLike:
        return self._dtype

    def arm(self) -> None:
        if self._acquirer.is_acquiring():
            self._acquirer.stop()
        self._acquirer.start()

    def lend(self, image: NDArray[Any]) -> None:
        self._lent.append(image)

    def wait(self, timeout_s: float) -> Shot | None:
        try:
            buffer = self._acquirer.fetch(timeout=timeout_s)
        except self._timeout:
            return None
        if buffer is None:
            return None
        with buffer:
            if not self._lent:
                self._losses["underrun"] += 1
                return None
            image = self._lent.popleft()
            image[:] = buffer.payload.components[0].data.reshape(self.shape)
            if self._first_id is None:
                self._first_id = buffer.frame_id
            self._clock.arrived(buffer.timestamp_ns, self.now_ns() - round(self._exposure_us * 1e3))
            trigger_ns = self._clock.rig_ns(buffer.timestamp_ns)
            return Shot(image, trigger_ns, buffer.frame_id - self._first_id, self._exposure_us)

    def set_exposure(self, exposure_us: float) -> None:
        self._nodes.ExposureTime.value = exposure_us
        self._exposure_us = float(self._nodes.ExposureTime.value)

    def now_ns(self) -> int:
        return time.time_ns()

    def losses(self) -> dict[str, int]:
        return dict(self._losses)

    def close(self) -> None:
        self._acquirer.destroy()
        self._harvester.reset()
        self._lent.clear()
