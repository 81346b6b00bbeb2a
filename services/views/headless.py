"""Rerun's own picture of a recording, without screen or graphics card (Mesa's software Vulkan)."""

from __future__ import annotations

import time
import warnings
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rerun.experimental import ViewerClient

from endo3d.services.runtime.errors import UserError
from endo3d.services.views.viewer_process import ViewerProcess

PACKAGES = "mesa-vulkan-drivers libvulkan1 libegl1 libxkbcommon0 libxkbcommon-x11-0"
LOOK_AGAIN_S = 0.4


def rerun_picture(
    recording: str | Path, path: str | Path, *, size: tuple[int, int] = (1600, 1000), timeout_s: float = 60.0
) -> None:
    """Opens a file (.rrd or .mcap) in a Rerun without window and saves what it shows as PNG.

    Waits until the view stands still. Raises ``UserError`` where Rerun can't draw.
    """
    viewer = ViewerProcess(arguments=("--headless", "--window-size", f"{size[0]}x{size[1]}"))
    try:
        with warnings.catch_warnings(action="ignore"):  # the client is an experiment of Rerun's, and says so
            client = ViewerClient.connect(viewer.url)
            if not client.open(str(Path(recording).absolute())).store_ids:
                raise UserError(f"Rerun can't open {recording}")
            seen = _still(client, timeout_s)
    except (RuntimeError, ConnectionError, OSError, ValueError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(f"Rerun can't draw here ({reason}); on Debian: apt-get install {PACKAGES}") from error
    finally:
        viewer.stop()
    Path(path).write_bytes(seen)


def _still(client: ViewerClient, timeout_s: float) -> bytes:
    """A screenshot that equals the one before: everything is loaded and nothing turns any more."""
    deadline = time.monotonic() + timeout_s
    before, seen = b"", b""
    while time.monotonic() < deadline:
        before, seen = seen, client.take_screenshot()
        if before and _same(before, seen):
            return seen
        time.sleep(LOOK_AGAIN_S)
    raise RuntimeError(f"the view doesn't come to rest within {timeout_s:g} s")


def _same(one: bytes, other: bytes) -> bool:
    return np.array_equal(_pixels(one), _pixels(other))


def _pixels(png: bytes) -> NDArray[np.uint8]:
    return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)  # type: ignore[return-value]
