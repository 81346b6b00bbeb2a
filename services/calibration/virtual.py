"""A calibration of the virtual rig: poses that a patient operator would take, rendered."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d.schemas.messages import Frame
from endo3d.services.calibration.captured import Captured, Images, Pose
from endo3d.services.evaluation.virtual_run import VirtualRun
from endo3d_core import patterns
from endo3d_core.calibrating.boards import Board
from endo3d_core.calibration import Rig
from endo3d_core.head import Head
from endo3d_core.patterns import Pattern
from endo3d_core.virtual_rig.camera_optics import CameraOptics
from endo3d_core.virtual_rig.effects import FULL, Effects
from endo3d_core.virtual_rig.sensor import Sensor, develop

COLUMNS = "conventional f=50/49/43 steps=4/2/2"
ROWS = f"{COLUMNS} axis=rows"
RATE_HZ = 132.0
TILT_DEG = 22.0
DEPTH_SHARE = 0.8
"""Of the head's depth range over which the poses are spread."""
SHIFT_SHARE = 0.12
"""Of the field by which the board leaves the middle."""
WHITES = 16
"""Images of an even light that are averaged."""
EVEN_LIGHT = 0.5


@dataclass(frozen=True, slots=True)
class VirtualCapture:
    """A head, a board, and the physics."""

    head_yaml: str
    board: Board
    poses: int = 15
    flats: int = 3
    effects: Effects = FULL
    seed: int = 0

    def scenes(self) -> Iterator[tuple[str, str]]:
        """(name, scene) of every pose."""
        head, rng = Head.from_yaml(self.head_yaml), np.random.default_rng(self.seed)
        middle, span = (head.z_min_mm + head.z_max_mm) / 2, head.z_max_mm - head.z_min_mm
        printed = self.board.text.replace(" ", ",")
        for index, at in enumerate(_spread(self.poses)):
            # Around the clock, so that every direction of tilt occurs; the depths in an order of their own.
            turn = TILT_DEG * np.array((np.cos(2.4 * index), np.sin(2.4 * index), rng.uniform(-1, 1)))
            x, y = rng.uniform(-SHIFT_SHARE, SHIFT_SHARE, 2) * head.field_mm
            z = middle + DEPTH_SHARE * span * (at - 0.5)
            words = f"at={x:.4f},{y:.4f},{z:.4f} turn={turn[0]:.3f},{turn[1]:.3f},{turn[2]:.3f}"
            yield f"board_{index:02d}", f"board print={printed} {words}"
        for index, at in enumerate(np.linspace(0.15, 0.85, self.flats) if self.flats > 1 else (0.5,) * self.flats):
            z = head.z_min_mm + span * at
            yield f"flat_{index:02d}", f"plane z={z:.4f} tilt={4.0 * (-1) ** index:g},{3.0 * (index % 3 - 1):g}"

    def run(self, scene: str, pattern_set: str) -> VirtualRun:
        """One sequence of one pose."""
        count = len(patterns.parse(pattern_set))
        return VirtualRun(
            self.head_yaml, scene, "still", pattern_set, RATE_HZ, count, seed=self.seed, effects=self.effects
        )

    def frames(self, scene: str, pattern_set: str, epoch: int) -> list[Frame]:
        """Rendered; ``epoch`` tells this start of the projector from others, in time too."""
        later_ns = epoch * 1_000_000_000
        return [
            replace(f, epoch=epoch, stamp_ns=f.stamp_ns + later_ns, trigger_ns=f.trigger_ns + later_ns)
            for f, _ in self.run(scene, pattern_set).shots()
        ]

    def side(self, scene: str, pattern_set: str) -> tuple[Images, tuple[Pattern, ...]]:
        """The same as images, rendered when they are read."""
        run = self.run(scene, pattern_set)

        def images() -> Iterator[NDArray[Any]]:
            return (frame.image for frame, _ in run.shots())

        return images, patterns.parse(pattern_set).patterns

    def captured(self) -> Captured:
        """What ``solve`` takes; nothing is rendered before it is looked at."""
        rig = Rig.from_yaml(self.head_yaml)
        poses = [Pose(name, self.side(scene, COLUMNS), self.side(scene, ROWS)) for name, scene in self.scenes()]
        return Captured(
            self.board,
            (rig.camera.width, rig.camera.height),
            (rig.projector.width, rig.projector.height),
            [pose for pose in poses if pose.name.startswith("board")],
            [pose for pose in poses if pose.name.startswith("flat")],
            np.mean(self.whites(), axis=0).astype(np.float32) if self.effects.camera_fibre else None,
            self.head_yaml,
            simulated=True,
        )

    def whites(self) -> list[NDArray[Any]]:
        """Images of an evenly lit white surface at the working distance, the projector dark."""
        rig, head = Rig.from_yaml(self.head_yaml), Head.from_yaml(self.head_yaml)
        sensor = Sensor()
        optics = CameraOptics(rig.camera, head, self.effects, 1)
        even = np.full(optics.rx.size, EVEN_LIGHT, np.float32)
        depth = np.full(optics.rx.size, head.working_distance_mm, np.float32)
        exposed = optics.expose(even, depth) * np.float32(sensor.flux_e_per_ms * 1e3 / RATE_HZ)
        images = []
        for number in range(WHITES):
            image = np.zeros((rig.camera.height, rig.camera.width), sensor.dtype)
            develop(sensor, exposed, optics.where, number, self.effects.noise, image)
            images.append(image)
        return images


def _spread(count: int) -> NDArray[np.float64]:
    """(count,) values over 0..1, neighbours far apart: the golden ratio's multiples."""
    return np.asarray((np.arange(count) * 0.6180339887 + 0.5) % 1.0)
