"""``aravis:``: USB3 Vision and GigE Vision cameras through Aravis. ``aravis:ID`` names one of several (its
Aravis id, serial number or IP address).

Needs Debian's gir1.2-aravis-0.8 and the extra ``endo3d[aravis]``. Options: ``trigger`` (a line of the camera,
``Line0`` by default, ``Software``, or ``none`` to run freely), ``exposure`` (``timed`` or ``width``: as long as the
trigger's pulse, for sets of several exposures), ``format`` (``Mono8``, ``Mono16``), ``width``, ``height``, ``x``, ``y``
(region; centred by default), ``bin``, ``fps`` (running freely).
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from endo3d.services.devices.camera import Shot
from endo3d.services.devices.camera_clock import CameraClock
from endo3d.services.devices.uri import DeviceError, Setting, Uri

DTYPES: dict[str, type[np.generic]] = {"Mono8": np.uint8, "Mono16": np.uint16}
LATCHES = (("TimestampLatch", "TimestampLatchValue"), ("GevTimestampControlLatch", "GevTimestampValue"))
MODES = {"timed": "Timed", "width": "TriggerWidth"}
GIGE_IDS = 65_535
"""GigE Vision counts frames from 1 to this and again."""


def open_uri(uri: Uri, setting: Setting) -> AravisCamera:
    options = {key: uri.text_of(key, default) for key, default in
               (("trigger", "Line0"), ("exposure", "timed"), ("format", "Mono8"))}  # fmt: skip
    region = {key: int(uri.number(key, -1)) for key in ("width", "height", "x", "y")}
    bin_px, fps = int(uri.number("bin", 1)), uri.number("fps", 0.0)
    uri.finish()
    if options["format"] not in DTYPES or options["exposure"] not in MODES:
        raise DeviceError(f"device {uri.text!r}: format is {' or '.join(DTYPES)}, exposure is {' or '.join(MODES)}")
    return AravisCamera(uri.body, region, bin_px, fps, **options)


def library() -> Any:
    """Aravis' GObject binding. Raises ``DeviceError`` with what to install."""
    try:
        import gi

        gi.require_version("Aravis", "0.8")
        from gi.repository import Aravis
    except (ImportError, ValueError) as error:
        raise DeviceError(
            f"Aravis is not installed ({error}); apt install gir1.2-aravis-0.8 libgirepository1.0-dev libcairo2-dev "
            "pkg-config, then pip install 'endo3d[aravis]'"
        ) from None
    return Aravis


def _raising(action: str) -> Any:
    """Aravis' errors as ours."""
    from contextlib import contextmanager

    from gi.repository import GLib

    @contextmanager
    def raising() -> Any:
        try:
            yield
        except GLib.Error as error:
            raise DeviceError(f"the camera can't {action}: {error.message}; see `endo3d devices`") from error

    return raising()


class AravisCamera:
    """Aravis fills the lent arrays themselves."""

    def __init__(
        self, name: str, region: dict[str, int], bin_px: int, fps: float, trigger: str, exposure: str, format: str
    ) -> None:
        self._aravis = library()
        with _raising(f"be opened ({name or 'the first one found'})"):
            self._camera = self._aravis.Camera.new(name or None)
        self._dtype = DTYPES[format]
        self.bin_px: int | None = bin_px
        self._gone = False
        self._camera.get_device().connect("control-lost", self._lose)
        with _raising("be set up"):
            self._set_up(region, bin_px, fps, trigger, exposure, format)
            self._stream = self._camera.create_stream(None, None)
        if self._stream is None:
            raise DeviceError("the camera gives no stream; is it open in another program?")
        self._lent: dict[int, tuple[Any, NDArray[Any]]] = {}
        """By Aravis buffer: itself and the array it fills, kept alive while the camera may write to it."""
        self._clock = CameraClock()
        self._exposure_us = 0.0
        self._acquiring = False
        self._last_id = 0
        self._frame_id = -1
        self._gaps = 0

    def _set_up(
        self, region: dict[str, int], bin_px: int, fps: float, trigger: str, exposure: str, format: str
    ) -> None:
        camera = self._camera
        camera.set_pixel_format_from_string(format)
        if bin_px > 1:
            camera.set_binning(bin_px, bin_px)
        full = camera.get_sensor_size()
        width = region["width"] if region["width"] > 0 else full.width // bin_px
        height = region["height"] if region["height"] > 0 else full.height // bin_px
        x = region["x"] if region["x"] >= 0 else (full.width // bin_px - width) // 2
        y = region["y"] if region["y"] >= 0 else (full.height // bin_px - height) // 2
        camera.set_region(x, y, width, height)
        got = camera.get_region()
        self.shape: tuple[int, int] = (got.height, got.width)
        self.corner: tuple[int, int] = (got.x, got.y)
        camera.set_acquisition_mode(self._aravis.AcquisitionMode.CONTINUOUS)
        if trigger == "none":
            camera.clear_triggers()
            if fps > 0.0:
                camera.set_frame_rate(fps)
        else:
            camera.set_trigger(trigger)
        if camera.is_feature_available("ExposureMode"):
            camera.set_string("ExposureMode", MODES[exposure])
        elif exposure != "timed":
            raise DeviceError("this camera has no ExposureMode: exposure=width is not possible with it")

    @property
    def dtype(self) -> DTypeLike:
        return self._dtype

    def arm(self) -> None:
        with _raising("be armed"):
            if self._acquiring:
                self._camera.stop_acquisition()
            while (buffer := self._stream.try_pop_buffer()) is not None:
                self._stream.push_buffer(buffer)
            self._latch()
            self._camera.start_acquisition()
        self._acquiring = True

    def _latch(self) -> None:
        """Read the camera's clock, if it lets itself be read."""
        for latch, value in LATCHES:
            if self._camera.is_feature_available(latch) and self._camera.is_feature_available(value):
                before_ns = self.now_ns()
                self._camera.execute_command(latch)
                after_ns = self.now_ns()
                ticks = self._camera.get_integer(value)
                tick_hz = 1_000_000_000
                if self._camera.is_feature_available("GevTimestampTickFrequency"):
                    tick_hz = self._camera.get_integer("GevTimestampTickFrequency") or tick_hz
                self._clock.latch(ticks * 1_000_000_000 // tick_hz, before_ns, after_ns)
                return

    def lend(self, image: NDArray[Any]) -> None:
        if image.shape != self.shape or image.dtype != self._dtype or not image.flags.c_contiguous:
            raise ValueError(f"{image.shape} {image.dtype} was lent; this camera fills {self.shape} {self._dtype}")
        buffer = self._aravis.Buffer.new(image.nbytes, image.ctypes.data)
        self._lent[hash(buffer)] = (buffer, image)
        self._stream.push_buffer(buffer)

    def wait(self, timeout_s: float) -> Shot | None:
        if self._gone:
            raise DeviceError("the camera is gone; plug it in again")
        buffer = self._stream.timeout_pop_buffer(max(0, round(timeout_s * 1e6)))
        if buffer is None:
            return None
        if buffer.get_status() != self._aravis.BufferStatus.SUCCESS:
            self._stream.push_buffer(buffer)  # its frame id will be missing
            return None
        _, image = self._lent.pop(hash(buffer))
        self._count(buffer.get_frame_id())
        stamp_ns, exposure_ns = buffer.get_timestamp(), round(self._exposure_us * 1e3)
        # The first packet leaves when the exposure has ended.
        self._clock.arrived(stamp_ns, buffer.get_system_timestamp() - exposure_ns)
        return Shot(image, self._clock.rig_ns(stamp_ns), self._frame_id, self._exposure_us)

    def _count(self, frame_id: int) -> None:
        """Ids that wrap become a count that doesn't."""
        if self._frame_id < 0:
            self._frame_id = 0
        else:
            step = frame_id - self._last_id
            step += GIGE_IDS if step <= 0 else 0
            self._frame_id += step
            self._gaps += step - 1
        self._last_id = frame_id

    def set_exposure(self, exposure_us: float) -> None:
        with _raising(f"expose for {exposure_us:g} us"):
            self._camera.set_exposure_time(exposure_us)
            self._exposure_us = self._camera.get_exposure_time()

    def software_trigger(self) -> None:
        """One exposure, with ``trigger=Software``."""
        with _raising("be triggered"):
            self._camera.software_trigger()

    def now_ns(self) -> int:
        return time.time_ns()

    def losses(self) -> dict[str, int]:
        underruns = self._stream.get_info_uint64_by_name("n_underruns") if self._stream is not None else 0
        return {"underrun": underruns, "transport": max(0, self._gaps - underruns)}

    def _lose(self, *_: object) -> None:
        self._gone = True

    def close(self) -> None:
        if self._acquiring and not self._gone:
            with _raising("be stopped"):
                self._camera.stop_acquisition()
        self._acquiring = False
        # The stream's thread ends with it; only then may the lent memory go.
        self._stream = self._camera = None
        self._lent.clear()
