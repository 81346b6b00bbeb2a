"""Milliseconds per frame of the virtual rig: the live preset and full physics.

    python -m bench.render

Goals: 960x600 live at 30 Hz or more on one core (33 ms); full physics at 1920x1200 in 500 ms on two cores.
"cpu" is the time the process spent computing: on a busy machine it tells more than the wall clock.
"""

from __future__ import annotations

import os
import time

import numpy as np

from endo3d.services.runtime.stack_file import stock
from endo3d_core import patterns
from endo3d_core.calibration import Rig
from endo3d_core.head import Head
from endo3d_core.virtual_rig import motion, scene
from endo3d_core.virtual_rig.effects import PRESETS
from endo3d_core.virtual_rig.renderer import Renderer

HEAD = "base6_wd20"
EXPOSURE_US = 5709.0
RATE_HZ = 172.0
SCENES = ("contour texture=noise:0.15:0.15", "blade texture=noise:0.15", "sphere r=3 at=0,0,21 + plane z=22")
CASES = (("fast", 2, 1, 60), ("full", 2, 1, 20), ("full", 1, 1, 10), ("full", 1, 2, 10))
"""Preset, binning, threads, frames."""


def measure(text: str, preset: str, bin_px: int, threads: int, frames: int) -> tuple[float, float, float]:
    """Median and 95 % of the wall time, median of the CPU time, ms per frame of a hand-guided scan."""
    yaml = stock("heads")[HEAD].read_text(encoding="utf-8")
    rig, pattern_set = Rig.from_yaml(yaml), patterns.parse("interleaved f1=15")
    what = scene.parse(text)
    renderer = Renderer(rig, Head.from_yaml(yaml), what, PRESETS[preset], bin_px=bin_px, threads=threads)
    window = rig.projector
    lights = [renderer.light(patterns.image(p, window.width, window.height)) for p in pattern_set.patterns]
    renderer.warm()
    path = motion.parse("hand seed=7").T_scene_camera
    image = np.empty((renderer.camera.height, renderer.camera.width), np.uint8)
    wall, cpu = np.empty(frames), np.empty(frames)
    for k in range(frames):
        began_s, began_cpu_s = time.perf_counter(), time.process_time()
        poses = renderer.poses(path, 1.0 + k / RATE_HZ, EXPOSURE_US)
        renderer.frame(lights[k % len(lights)], poses, EXPOSURE_US, k, image)
        wall[k], cpu[k] = time.perf_counter() - began_s, time.process_time() - began_cpu_s
    return 1e3 * float(np.median(wall)), 1e3 * float(np.quantile(wall, 0.95)), 1e3 * float(np.median(cpu))


def main() -> None:
    print("preset, image, threads, scene: median, 95 %, cpu ms per frame")
    for preset, bin_px, threads, frames in CASES:
        if threads > (os.cpu_count() or 1):
            continue
        for text in SCENES:
            median, slow, cpu = measure(text, preset, bin_px, threads, frames)
            size = f"{1920 // bin_px}x{1200 // bin_px}"
            print(f"{preset:5} {size:9} {threads}  {text:36} {median:6.1f} {slow:6.1f} {cpu:6.1f}", flush=True)


if __name__ == "__main__":
    main()
