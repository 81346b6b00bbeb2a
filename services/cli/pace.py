"""How fast the virtual rig can be run on this machine, right now: the live demo has to fit it."""

from __future__ import annotations

import hashlib
import os
import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from endo3d.services.devices.uri import Uri
from endo3d.services.runtime.stack_file import Stack
from endo3d_core import patterns
from endo3d_core.calibration import Rig
from endo3d_core.head import Head
from endo3d_core.virtual_rig import motion, scene
from endo3d_core.virtual_rig.effects import PRESETS
from endo3d_core.virtual_rig.renderer import Renderer

PAPER_HZ = 172.0
"""The paper's hand-guided rate: what the simulated hand is scanned at, however slowly."""
FASTEST_HZ, SLOWEST_HZ = 40.0, 2.0
SHARE = 0.5
"""Of a frame period that rendering may take: the rest of the stack needs the machine as well."""
MEASURED_S = 1.0
BUSY_CORES = 2
"""What the rest of the stack takes at most."""
SLOWER = 0.6
"""Of a rate that turned out too fast for this machine: the next to try."""


@dataclass(frozen=True)
class Pace:
    """What the demo will run at."""

    render_ms: float
    """Per frame, measured."""
    rate_hz: float
    scene: str
    """The camera's URI without its slow motion, which follows from the rate."""

    @property
    def slow_motion(self) -> float:
        return PAPER_HZ / self.rate_hz

    def describe(self) -> str:
        scan = f"a scan at {PAPER_HZ:g} Hz in slow motion {self.slow_motion:.1f}"
        return f"Rendering takes {self.render_ms:.1f} ms per frame on this machine now: {self.rate_hz:g} Hz, {scan}."

    def slower(self) -> Pace | None:
        """The next rate to try when this one can't be held; None when there is no slower one."""
        rate_hz = round(max(SLOWEST_HZ, SLOWER * self.rate_hz), 1)
        return replace(self, rate_hz=rate_hz) if rate_hz < self.rate_hz else None

    def overrides(self) -> list[str]:
        joint = "&" if "?" in self.scene else "?"
        camera = f"{self.scene}{joint}slow_motion={self.slow_motion:.3f}"
        return [f"sequencer.rate_hz={self.rate_hz:.1f}", f"grabber.camera={camera}"]


def measure(stack: Stack) -> Pace | None:
    """Render for a second as the grabber will; None for a stack whose camera isn't the virtual one."""
    text = str(stack.tables.get("grabber", {}).get("camera", ""))
    if not text.startswith("sim:"):
        return None
    render_s = _frame_s(Uri.parse(text), stack.head.read_text(encoding="utf-8"))
    rate_hz = float(np.clip(SHARE / render_s, SLOWEST_HZ, FASTEST_HZ).round(1))
    return Pace(1e3 * render_s, rate_hz, re.sub(r"[?&]slow_motion=[^&]*", "", text))


def _frame_s(uri: Uri, head_yaml: str) -> float:
    """Seconds per frame, with everything else that runs on this machine now, and cores as busy as they will be."""
    rig, head = Rig.from_yaml(head_yaml), Head.from_yaml(head_yaml)
    preset = PRESETS[uri.text_of("preset", "fast")]
    seen = scene.parse(uri.body, head.working_distance_mm)
    renderer = Renderer(rig, head, seen, preset, bin_px=int(uri.number("bin", 2)))
    renderer.warm()
    hand = motion.parse(uri.text_of("motion", "hand"))
    pattern = patterns.parse("interleaved f1=15").patterns[0]
    light = renderer.light(patterns.image(pattern, rig.projector.width, rig.projector.height))
    image = np.empty((renderer.camera.height, renderer.camera.width), renderer.sensor.dtype)
    with _busy():
        began_s, frames = time.perf_counter(), 0
        while time.perf_counter() - began_s < MEASURED_S:
            poses = renderer.poses(hand.T_scene_camera, frames / PAPER_HZ, 1e6 / PAPER_HZ)
            renderer.frame(light, poses, 1e6 / PAPER_HZ, frames, image)
            frames += 1
        return (time.perf_counter() - began_s) / frames


@contextmanager
def _busy() -> Iterator[None]:
    """The other cores at work: a machine that is slower then (shared, throttled) is measured as such."""
    ended, block = threading.Event(), bytes(1 << 20)

    def work() -> None:
        while not ended.is_set():
            hashlib.sha256(block)  # lets go of the interpreter meanwhile

    others = min(BUSY_CORES, max(1, len(os.sched_getaffinity(0)) - 1))
    threads = [threading.Thread(target=work, daemon=True) for _ in range(others)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        ended.set()
        for thread in threads:
            thread.join()
