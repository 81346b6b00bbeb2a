"""Milliseconds per decoded frame, 1920x1200 Mono8 in, one thread, warm; simulated frames.

    python -m bench.decode

"cpu" is the thread's computing time: on a busy machine it tells more than the wall clock. The limit is the time that
the bytes of a step need at the copy bandwidth measured beside it; the share says how near the step comes.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from endo3d.services.runtime.stack_file import stock
from endo3d_core import patterns, triangulation
from endo3d_core.calibration import Rig
from endo3d_core.compiled import kernel
from endo3d_core.conventional import Conventional
from endo3d_core.head import Head
from endo3d_core.interleaved import Interleaved
from endo3d_core.virtual_rig import scene
from endo3d_core.virtual_rig.effects import FAST
from endo3d_core.virtual_rig.renderer import Renderer

HEAD, SCENE = "base6_wd20", "sphere r=3 at=0,0,21 + plane z=22"
EXPOSURE_US = 5709.0
SETS = ("interleaved f1=25", "conventional f=50/49/43 steps=4/2/2")
HDR = SETS[1] + " exposures_us=2500/5000/10000"
Row = tuple[str, float, float, float, float, float | None]
"""Name, goal, wall p50, wall p99, CPU p50 (ms), MB moved."""


def rendered(rig: Rig, head: Head, text: str) -> list[NDArray[np.uint8]]:
    """One period of frames of the scene, without fibres."""
    renderer = Renderer(rig, head, scene.parse(SCENE), FAST)
    out = []
    for k, pattern in enumerate(patterns.parse(text).patterns):
        image = np.empty((rig.camera.height, rig.camera.width), np.uint8)
        light = renderer.light(patterns.image(pattern, rig.projector.width, rig.projector.height))
        renderer.frame(light, [np.eye(4)], pattern.exposure_us or EXPOSURE_US, k, image)
        out.append(image)
    return out


def timed(step: Callable[[int], object], repeats: int, skip: int) -> tuple[float, float, float]:
    """Median and 99 % of the wall time, median of the CPU time, ms."""
    wall, cpu = np.empty(repeats), np.empty(repeats)
    for k in range(repeats):
        began_s, began_cpu_s = time.perf_counter(), time.thread_time()
        step(k)
        wall[k], cpu[k] = time.perf_counter() - began_s, time.thread_time() - began_cpu_s
    wall, cpu = 1e3 * wall[skip:], 1e3 * cpu[skip:]
    return float(np.median(wall)), float(np.quantile(wall, 0.99)), float(np.median(cpu))


def continuous(rig: Rig, frames: list[NDArray[np.uint8]], name: str, goal: float, bin_px: int, fit: bool) -> Row:
    """A step of the continuous mode: one frame in, XYZ + intensity + quality + sigma out."""
    lookup = triangulation.build(rig, bin_px, 16.5, 23.5)
    decoder = Interleaved(patterns.parse(SETS[0]), lookup, bin_px, fit=fit)
    points = np.zeros((lookup.height, lookup.width, 6), np.float32)

    def step(k: int) -> None:
        if decoder.push(frames[k % 4], k % 4):
            decoder.points(points)

    # Image in; of each grid pixel: a frame written, 3 + 3 read to normalise and average, sample and phasor written,
    # 3 phasors read, 6 planes written and read once, 24 bytes of point; the fit reads 6 planes and writes 3.
    floats = 1 + 6 + 3 + 6 + 12 + 6 + (9 if fit else 0)
    moved = (frames[0].nbytes + points.shape[0] * points.shape[1] * 4 * floats) / 1e6
    return (name, goal, *timed(step, 150, 20), moved)


def whole(rig: Rig, frames: list[NDArray[np.uint8]], name: str, goal: float, bin_px: int, text: str) -> Row:
    """Decoding a complete sequence that is in memory, to XYZ + intensity + quality + sigma."""
    lookup = triangulation.build(rig, bin_px, 16.5, 23.5)
    decoder = Conventional(patterns.parse(text), lookup, bin_px)
    points = np.zeros((lookup.height, lookup.width, 6), np.float32)
    for k, frame in enumerate(frames):
        decoder.push(frame, k)
    moved = (len(frames) * lookup.height * lookup.width * (1 if bin_px == 1 else 4) + points.nbytes) / 1e6
    return (name, goal, *timed(lambda _: decoder.points(points), 24, 3), moved)


def published(frames: list[NDArray[np.uint8]], period_px: float) -> Row:
    """Eqs. (4) to (6) and the Fourier method in plain numpy, float64; to the beat and the wrapped phase only."""
    before, centre, after = (frame.astype(np.float64) for frame in frames[:3])
    frequency = np.fft.fftfreq(before.shape[1])
    band = np.exp(-0.5 * ((frequency - 1 / period_px) * period_px / 0.35) ** 2) * (frequency > 0)

    def step(_: int) -> NDArray[np.float64]:
        a = before + after + 1e-9
        s1, s2 = 0.5 * (before - after) / a, (centre - a / 2) / a
        phasors = [np.fft.ifft(np.fft.fft(s, axis=1) * band, axis=1) for s in (s1, s2)]
        fine, beat = np.angle(phasors[0]), np.angle(phasors[0] * np.conj(phasors[1]))
        return np.asarray(fine + 2 * np.pi * np.round((25 * beat - fine) / (2 * np.pi)))

    return ("published method, numpy float64, phase only", float("nan"), *timed(step, 7, 2), None)


@kernel
def _copy(a: NDArray[np.float32], b: NDArray[np.float32]) -> None:
    for i in range(a.size):
        b[i] = a[i]


def bandwidth_gb_s() -> float:
    """Of a copy that does not fit into the caches below the last, read and write counted."""
    a, b = np.ones((2, 16_000_000), np.float32)
    _, _, ms = timed(lambda _: _copy(a, b), 9, 2)
    return 2 * a.nbytes / 1e6 / ms


def main() -> None:
    yaml = stock("heads")[HEAD].read_text(encoding="utf-8")
    rig, head = Rig.from_yaml(yaml), Head.from_yaml(yaml)
    running, still, hdr = (rendered(rig, head, text) for text in (*SETS, HDR))
    speed = bandwidth_gb_s()
    rows = [
        continuous(rig, running, "continuous 4x4, band-pass", 0.9, 4, False),
        continuous(rig, running, "continuous 4x4, windowed fit (default)", 2.5, 4, True),
        continuous(rig, running, "continuous 2x2, band-pass", 2.0, 2, False),
        continuous(rig, running, "continuous 2x2, windowed fit", 6.0, 2, True),
        whole(rig, still, "conventional, 8 patterns, full resolution", 4.0, 1, SETS[1]),
        whole(rig, still, "conventional, 8 patterns, 4x4", float("nan"), 4, SETS[1]),
        whole(rig, hdr, "conventional, HDR 3x8, full resolution", 10.0, 1, HDR),
        published(running, 52.0),
    ]
    print(f"1920x1200 Mono8 in, one thread; copy bandwidth {speed:.1f} GB/s; ms")
    print(f"{'':46s} {'goal':>6s} {'p50':>7s} {'p99':>7s} {'cpu':>7s} {'MB':>6s} {'limit':>6s} {'share':>6s}")
    for name, goal, p50, p99, cpu, moved in rows:
        wanted = f"{goal:6.1f}" if goal == goal else "     -"
        bound = f"{moved:6.1f} {moved / speed:6.2f} {moved / speed / cpu:6.0%}" if moved else ""
        print(f"{name:46s} {wanted} {p50:7.2f} {p99:7.2f} {cpu:7.2f} {bound}")


if __name__ == "__main__":
    main()
