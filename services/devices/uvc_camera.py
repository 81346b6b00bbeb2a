"""``uvc:N``: video endoscopes and webcams through OpenCV (V4L2). ``uvc:/dev/video2``, a stream's address or a
video file work too.

Such a camera runs freely and stamps on arrival: project slower than it films (conventional sequences with
exposures of several video frames). Options: ``width``, ``height``, ``fps``, ``channel`` (``grey``, ``red``, ``green``,
``blue``), ``delay_us`` (from mid-exposure to arrival).
"""

from __future__ import annotations

import time
from collections import deque
from typing import Any

import cv2
import numpy as np
from numpy.typing import DTypeLike, NDArray

from endo3d.services.devices.camera import Shot
from endo3d.services.devices.uri import DeviceError, Setting, Uri

CHANNELS = {"blue": 0, "green": 1, "red": 2}
MANUAL_EXPOSURE = 1
"""V4L2's V4L2_EXPOSURE_MANUAL."""
EXPOSURE_STEP_US = 100.0
"""V4L2 counts exposures in these."""


def open_uri(uri: Uri, setting: Setting) -> UvcCamera:
    channel = uri.text_of("channel", "grey")
    wanted = {
        cv2.CAP_PROP_FRAME_WIDTH: uri.number("width", 0),
        cv2.CAP_PROP_FRAME_HEIGHT: uri.number("height", 0),
        cv2.CAP_PROP_FPS: uri.number("fps", 0),
    }
    delay_us = uri.number("delay_us", 0.0)
    uri.finish()
    if channel not in ("grey", *CHANNELS):
        raise DeviceError(f"device {uri.text!r}: channel is grey, {', '.join(CHANNELS)}")
    return UvcCamera(uri.body or "0", wanted, channel, delay_us)


class UvcCamera:
    """Frames are decoded by OpenCV and converted into the lent array."""

    def __init__(self, source: str, wanted: dict[int, float], channel: str, delay_us: float) -> None:
        self._source, self._channel, self._delay_us = source, channel, delay_us
        self._capture = cv2.VideoCapture(int(source) if source.isdecimal() else source)
        if not self._capture.isOpened():
            self._capture.release()
            raise DeviceError(f"no video from {source!r}; see `endo3d devices` for what is attached")
        for key, value in wanted.items():
            if value and not self._capture.set(key, value):
                self._capture.release()
                raise DeviceError(f"the camera {source!r} refused {value:g}; see `v4l2-ctl --list-formats-ext`")
        read, frame = self._capture.read()
        if not read:
            self._capture.release()
            raise DeviceError(f"{source!r} was opened but gives no images; is it used by another program?")
        self.shape: tuple[int, int] = frame.shape[:2]
        self.corner, self.bin_px = (0, 0), None
        self._first: NDArray[Any] | None = frame
        self._lent: deque[NDArray[Any]] = deque()
        fps = self._capture.get(cv2.CAP_PROP_FPS)
        self._exposure_us = 1e6 / fps if fps > 0 else 33_333.0
        self._frame_id = -1
        self._losses = {"underrun": 0}

    @property
    def dtype(self) -> DTypeLike:
        return np.uint8

    def arm(self) -> None:
        """It runs already."""

    def lend(self, image: NDArray[Any]) -> None:
        self._lent.append(image)

    def wait(self, timeout_s: float) -> Shot | None:
        """The next frame; waits for it as long as the camera takes, which OpenCV gives no way to shorten."""
        frame = self._next()
        arrived_ns = self.now_ns()
        self._frame_id += 1
        if not self._lent:
            self._losses["underrun"] += 1
            return None
        image = self._lent.popleft()
        if frame.ndim == 2:
            image[:] = frame
        elif self._channel == "grey":
            cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY, dst=image)
        else:
            image[:] = frame[..., CHANNELS[self._channel]]
        trigger_ns = arrived_ns - round((self._delay_us + 0.5 * self._exposure_us) * 1e3)
        return Shot(image, trigger_ns, self._frame_id, self._exposure_us)

    def _next(self) -> NDArray[Any]:
        if self._first is not None:
            frame, self._first = self._first, None
            return frame
        read, frame = self._capture.read()
        if not read:
            raise DeviceError(f"no more images from {self._source!r}; plug the camera in again")
        return frame

    def set_exposure(self, exposure_us: float) -> None:
        """Where the camera knows manual exposure; files and some cameras don't."""
        self._capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, MANUAL_EXPOSURE)
        self._capture.set(cv2.CAP_PROP_EXPOSURE, exposure_us / EXPOSURE_STEP_US)

    def now_ns(self) -> int:
        return time.time_ns()

    def losses(self) -> dict[str, int]:
        return dict(self._losses)

    def close(self) -> None:
        self._capture.release()
        self._lent.clear()
