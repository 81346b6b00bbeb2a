"""The camera's image of a scene under a pattern, in the order of the light's way."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d_core.calibration import Rig
from endo3d_core.head import Head
from endo3d_core.virtual_rig import sensor
from endo3d_core.virtual_rig.camera_optics import CameraOptics
from endo3d_core.virtual_rig.effects import FULL, Effects
from endo3d_core.virtual_rig.light import Light, ProjectorOptics
from endo3d_core.virtual_rig.radiance import Radiance
from endo3d_core.virtual_rig.scene import Scene
from endo3d_core.virtual_rig.sensor import Sensor

Pose = NDArray[np.float64]

SUB_POSES = 4
"""Of an exposure, for motion blur."""


class Renderer:
    """One head, one scene. Not for two callers at once."""

    def __init__(
        self,
        rig: Rig,
        head: Head,
        scene: Scene,
        effects: Effects = FULL,
        *,
        bin_px: int = 1,
        bits: int = 8,
        threads: int = 1,
    ) -> None:
        self.scene, self.effects = scene, effects
        self.camera = rig.camera.binned(bin_px) if bin_px > 1 else rig.camera
        self.sensor = Sensor(bits=bits if effects.quantisation else 16)
        self._window = rig.projector
        self._projector = ProjectorOptics(rig, head, effects)
        self._optics = CameraOptics(self.camera, head, effects, bin_px)
        rays = self._optics.rx, self._optics.ry
        self._radiance = Radiance(rig, head, scene, effects, rays, threads)
        self._sum, self._part, self._depth = (np.empty(rays[0].size, np.float32) for _ in range(3))

    def warm(self) -> None:
        """Compile and touch everything that a frame needs."""
        blank = self.light(np.zeros((self._window.height, self._window.width), np.uint8))
        shape = (self.camera.height, self.camera.width)
        self.frame(blank, [np.eye(4)], 1.0, 0, np.empty(shape, self.sensor.dtype))

    def light(self, image: NDArray[np.uint8], gamma: float = 1.0) -> Light:
        """What a pattern image (rows, columns) becomes; slow, so keep it."""
        return self._projector.light(image, gamma)

    def poses(self, path: Callable[[float], Pose], middle_s: float, exposure_us: float) -> Sequence[Pose]:
        """The poses of an exposure: several when the head moves and motion blur is on."""
        if not self.effects.motion_blur:
            return [path(middle_s)]
        steps = (np.arange(SUB_POSES) + 0.5) / SUB_POSES - 0.5
        poses = [path(middle_s + step * exposure_us * 1e-6) for step in steps]
        return poses[:1] if all(np.array_equal(pose, poses[0]) for pose in poses) else poses

    def exposure(self, light: Light, poses: Sequence[Pose]) -> NDArray[np.float32]:
        """(n,) relative exposure of the pixels ``where``: 1 is white, upright, fully lit, mid-field."""
        self._radiance.of(light, poses[0], self._sum, self._depth)
        for pose in poses[1:]:
            self._radiance.of(light, pose, self._part, self._depth)
            self._sum += self._part
        self._sum *= np.float32(1.0 / len(poses))
        return self._optics.expose(self._sum, self._depth)

    @property
    def where(self) -> NDArray[np.uint32]:
        """(n,) flat index in the image of the pixels that see something."""
        return self._optics.where

    def frame(
        self,
        light: Light,
        poses: Sequence[Pose],
        exposure_us: float,
        number: int,
        out: NDArray[Any],
    ) -> None:
        """Render into ``out`` (height, width) of the sensor's dtype; ``number`` seeds the frame's noise."""
        electrons = self.exposure(light, poses)
        electrons *= np.float32(self.sensor.flux_e_per_ms * exposure_us * 1e-3)
        out.fill(0)
        sensor.develop(self.sensor, electrons, self.where, number, self.effects.noise, out)
