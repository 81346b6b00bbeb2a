"""Rerun's own picture of a recording, without screen or graphics card (Mesa's software Vulkan)."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from endo3d.services.runtime.errors import UserError
from endo3d.services.views.viewer_process import executable

PACKAGES = "mesa-vulkan-drivers libvulkan1 libegl1 libxkbcommon0 libxkbcommon-x11-0"


def rerun_picture(
    recording: str | Path, path: str | Path, *, size: tuple[int, int] = (1600, 1000), timeout_s: float = 60.0
) -> None:
    """Opens a file (.rrd or .mcap) in a Rerun without window and saves what it shows as PNG.

    Raises ``UserError`` where Rerun can't draw.
    """
    target = Path(path).absolute()
    target.unlink(missing_ok=True)
    command = [str(executable()), str(recording), "--headless", "--bind", "127.0.0.1", "--port", "auto"]
    command += ["--window-size", f"{size[0]}x{size[1]}", "--screenshot-to", str(target)]
    environment = {"RUST_LOG": "error", **os.environ}
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=timeout_s, env=environment, check=False
        )
        said = done.stderr.strip().splitlines()
    except subprocess.TimeoutExpired:
        said = [f"no picture within {timeout_s:g} s"]
    if not target.is_file():
        reason = said[-1] if said else "no reason given"
        raise UserError(f"Rerun can't draw here ({reason}); on Debian: apt-get install {PACKAGES}")
