"""A run of the virtual rig as messages: what the grabber and the sequencer would have published."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d.schemas.messages import CameraCalibration, Frame, Message, Mode, ProjectorCalibration, Truth
from endo3d.services.devices.slots import timeline
from endo3d.services.runtime.stack_file import stock
from endo3d_core import patterns
from endo3d_core.calibration import Rig
from endo3d_core.head import Head
from endo3d_core.virtual_rig import motion as motions
from endo3d_core.virtual_rig import scene as scenes
from endo3d_core.virtual_rig.effects import FULL, Effects
from endo3d_core.virtual_rig.light import Light
from endo3d_core.virtual_rig.renderer import Renderer

START_NS = 1_700_000_000_000_000_000
"""A run's own clock: the same run gives the same messages, to the bit."""
DARK_US = 105.0


@dataclass(frozen=True, slots=True)
class VirtualRun:
    """Everything that decides what the camera sees."""

    head_yaml: str = field(repr=False)
    """The true rig."""
    scene: str
    motion: str
    pattern_set: str
    rate_hz: float
    frames: int
    seed: int = 0
    effects: Effects = FULL
    bin_px: int = 1
    begin_s: float = 0.0
    """Where on the motion's path the first pattern is shown."""

    def check(self) -> None:
        """Raises ``ValueError`` that says what is wrong with a description."""
        head = Head.from_yaml(self.head_yaml)
        scenes.parse(self.scene, head.working_distance_mm)
        motions.parse(self.motion)
        patterns.parse(self.pattern_set)

    @property
    def exposure_us(self) -> float:
        return 1e6 / self.rate_hz - DARK_US

    def calibration(self, yaml: str | None = None) -> Iterator[Message]:
        """What the decoder is told of the rig: the truth, or another file."""
        text = yaml or self.head_yaml
        rig = Rig.from_yaml(text)
        lens = rig.camera.binned(self.bin_px) if self.bin_px > 1 else rig.camera
        p = rig.projector
        yield CameraCalibration(START_NS, lens.width, lens.height, lens.K, lens.dist)
        yield ProjectorCalibration(START_NS, p.width, p.height, p.K, p.dist, rig.T_projector_camera, text)

    def mode(self) -> Mode:
        period_ns = round(1e9 / self.rate_hz)
        name = self.pattern_set.split()[0]
        return Mode(START_NS, name, self.pattern_set, 1, START_NS, period_ns, self.exposure_us, running=True)

    def shots(self, first: int = 0, threads: int = 1) -> Iterator[tuple[Frame, Truth]]:
        """Frames and their truth, in order, from frame ``first`` on."""
        rig, head = Rig.from_yaml(self.head_yaml), Head.from_yaml(self.head_yaml)
        scene = scenes.parse(self.scene, head.working_distance_mm)
        path = motions.parse(self.motion).T_scene_camera
        renderer = Renderer(rig, head, scene, self.effects, bin_px=self.bin_px, threads=threads)
        lights = _lights(self.head_yaml, self.effects, self.pattern_set)
        when = timeline(self.pattern_set, START_NS, self.exposure_us, DARK_US)
        shape = renderer.camera.height, renderer.camera.width
        for sequence in range(first, self.frames):
            trigger_ns, slot = when.trigger_ns(sequence), sequence % when.slots
            exposure_us = when.exposures_us[slot]
            stamp_ns = trigger_ns + round(500 * exposure_us)
            path_s = self.begin_s + (stamp_ns - START_NS) * 1e-9
            image: NDArray[Any] = np.empty(shape, renderer.sensor.dtype)
            number = self.seed * 1_000_003 + sequence
            renderer.frame(lights[slot], renderer.poses(path, path_s, exposure_us), exposure_us, number, image)
            frame = Frame(stamp_ns, sequence, image, self.pattern_set, slot, 1, exposure_us, trigger_ns, sequence)
            yield frame, Truth(stamp_ns, sequence, path(path_s), self.scene)


@lru_cache(maxsize=2)
def _lights(head_yaml: str, effects: Effects, pattern_set: str) -> list[Light]:
    """Per slot; equal patterns share theirs."""
    rig, head = Rig.from_yaml(head_yaml), Head.from_yaml(head_yaml)
    blank = Renderer(rig, head, scenes.parse("plane"), effects, bin_px=8)
    shown: dict[patterns.Pattern, Light] = {}
    lights = []
    for pattern in patterns.parse(pattern_set).patterns:
        look = patterns.Pattern(pattern.frequency, pattern.shift_rad, pattern.axis, pattern.wave, pattern.gamma)
        if look not in shown:
            image = patterns.image(pattern, rig.projector.width, rig.projector.height)
            shown[look] = blank.light(image)
        lights.append(shown[look])
    return lights


def head_yaml(name: str) -> str:
    """The text of a stock head's file."""
    return stock("heads")[name].read_text(encoding="utf-8")
