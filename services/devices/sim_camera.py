"""``sim:SCENE?motion=...``: a camera that renders what it would see of the simulated bench.

The body is a scene's text (``contour texture=noise:0.15``). Options: ``motion`` (``hand seed=7``), ``preset``
(fast, full, ideal), ``bin`` (pixels per pixel, 2 gives 960x600), ``slow_motion`` (seconds of wall time per
simulated second: exposures and motion are those of the simulated time), ``seed`` of the noise, ``bench``
(path), ``cable`` (a file that stands for the trigger's cable: without it no image comes).
"""

from __future__ import annotations

import time
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from endo3d.services.devices.bench import Bench, Shown, default_path
from endo3d.services.devices.camera import Shot
from endo3d.services.devices.uri import DeviceError, Setting, Uri
from endo3d_core.calibration import Rig
from endo3d_core.head import Head
from endo3d_core.slot_identity import Timeline
from endo3d_core.virtual_rig import motion as motions
from endo3d_core.virtual_rig import scene as scenes
from endo3d_core.virtual_rig.effects import PRESETS
from endo3d_core.virtual_rig.light import Light
from endo3d_core.virtual_rig.motion import Motion
from endo3d_core.virtual_rig.renderer import Renderer

DEFAULT_SCENE = "contour texture=noise:0.15:0.15"


def open_uri(uri: Uri, setting: Setting) -> SimCamera:
    path = Path(uri.text_of("bench", str(default_path(setting.rig))))
    preset = uri.text_of("preset", "fast")
    if preset not in PRESETS:
        raise DeviceError(f"device {uri.text!r}: preset={preset} is not one of: {', '.join(PRESETS)}")
    rig, head = Rig.from_yaml(setting.head_yaml), Head.from_yaml(setting.head_yaml)
    try:
        scene = scenes.parse(uri.body or DEFAULT_SCENE, head.working_distance_mm)
        motion = motions.parse(uri.text_of("motion", "hand"))
    except ValueError as error:
        raise DeviceError(f"device {uri.text!r}: {error}") from error
    slow_motion, seed, bin_px = uri.number("slow_motion", 1.0), uri.number("seed", 0), uri.number("bin", 2)
    cable = uri.text_of("cable", "")
    uri.finish()
    if not slow_motion > 0.0:
        raise DeviceError(f"device {uri.text!r}: slow_motion must be positive")
    renderer = Renderer(rig, head, scene, PRESETS[preset], bin_px=int(bin_px))
    triggered_by = Path(cable) if cable else None
    return SimCamera(Bench(path), renderer, motion, slow_motion, int(seed), int(bin_px), triggered_by)


class SimCamera:
    """Triggered by the bench's light; as on a real one, a trigger while it is busy makes no frame."""

    def __init__(
        self,
        bench: Bench,
        renderer: Renderer,
        motion: Motion,
        slow_motion: float,
        seed: int,
        bin_px: int,
        cable: Path | None = None,
    ) -> None:
        self._bench, self._renderer, self._motion = bench, renderer, motion
        self.scene, self.slow_motion = renderer.scene.text, slow_motion
        self.corner, self.bin_px = (0, 0), bin_px
        self._seed = seed
        self._cable = cable
        self._lent: deque[NDArray[Any]] = deque()
        self._shown, self._changes = Shown(), -1
        self._timeline: Timeline | None = None
        self._lights: list[Light] = []
        self._generation = -1
        self._next = 0
        self._frame_id = 0
        self._exposing: Shot | None = None
        self._losses = {"underrun": 0}

    @property
    def shape(self) -> tuple[int, int]:
        return self._renderer.camera.height, self._renderer.camera.width

    @property
    def dtype(self) -> DTypeLike:
        return self._renderer.sensor.dtype

    def arm(self) -> None:
        self._changes = -1
        self._look()
        self._renderer.warm()
        if self._timeline is not None:
            self._next = max(0, self._timeline.last_begun(self.now_ns()) + 1)

    def lend(self, image: NDArray[Any]) -> None:
        self._lent.append(image)

    def wait(self, timeout_s: float) -> Shot | None:
        deadline_ns = self.now_ns() + int(timeout_s * 1e9)
        self._look()
        if self._timeline is None or (self._cable is not None and not self._cable.exists()):
            time.sleep(max(0.0, timeout_s))
            return None
        if self._exposing is not None:
            return self._finish(deadline_ns)
        # While it exposes one pattern it is blind for the next; what it could not begin in time is missed.
        self._next = max(self._next, self._timeline.last_begun(self.now_ns()))
        trigger_ns = self._timeline.trigger_ns(self._next)
        if trigger_ns > deadline_ns:
            _sleep_until(deadline_ns)
            return None
        slot = self._next % self._timeline.slots
        self._next += 1
        if not self._lent:
            self._losses["underrun"] += 1
            self._frame_id += 1
            return None
        self._exposing = self._expose(slot, trigger_ns)
        return None

    def _expose(self, slot: int, trigger_ns: int) -> Shot:
        assert self._timeline is not None
        image, exposure_us = self._lent.popleft(), self._timeline.exposures_us[slot]
        middle_ns = trigger_ns + round(exposure_us * 500)
        number = (trigger_ns - self._shown.begun_ns) // 1000 + self._seed * 7919
        simulated_us = exposure_us / self.slow_motion
        poses = self._renderer.poses(self._motion.T_scene_camera, self._simulated_s(middle_ns), simulated_us)
        light = self._lights[self._shown.images[slot]]
        self._renderer.frame(light, poses, simulated_us, number, image)
        self._frame_id += 1
        return Shot(image, trigger_ns, self._frame_id - 1, exposure_us)

    def _finish(self, deadline_ns: int) -> Shot | None:
        """The shot, when its exposure has ended."""
        shot = self._exposing
        assert shot is not None
        ends_ns = shot.trigger_ns + round(shot.exposure_us * 1000)
        _sleep_until(min(ends_ns, deadline_ns))
        if ends_ns > deadline_ns:
            return None
        self._exposing = None
        return shot

    def set_exposure(self, exposure_us: float) -> None:
        """The bench's light ends the exposure."""

    def T_scene_camera(self, stamp_ns: int) -> NDArray[np.float64]:
        return self._motion.T_scene_camera(self._simulated_s(stamp_ns))

    def _simulated_s(self, stamp_ns: int) -> float:
        return (stamp_ns - self._shown.begun_ns) * 1e-9 / self.slow_motion

    def now_ns(self) -> int:
        return time.time_ns()

    def losses(self) -> dict[str, int]:
        return dict(self._losses)

    def close(self) -> None:
        self._lent.clear()
        self._bench.close()

    def _look(self) -> None:
        """Take over what the projector shows when it has changed."""
        if self._bench.changes == self._changes:
            return
        self._changes = self._bench.changes
        self._shown = shown = self._bench.read()
        self._next = 0
        self._timeline = shown.timeline
        if self._exposing is not None:  # cut off by the projector: no whole image
            self._lent.append(self._exposing.image)
            self._exposing = None
        if shown.generation != self._generation:
            self._lights = [self._renderer.light(self._bench.image(place, shown)) for place in range(shown.placed)]
            self._generation = shown.generation


def _sleep_until(stamp_ns: int) -> None:
    time.sleep(max(0, stamp_ns - time.time_ns()) * 1e-9)
