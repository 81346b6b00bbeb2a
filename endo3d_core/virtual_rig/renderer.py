"""The camera's image of a scene under a pattern: rays, surfaces, light, sensor."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from endo3d_core.calibration import Lens, Rig
from endo3d_core.head import Head
from endo3d_core.virtual_rig import material, sensor, shading
from endo3d_core.virtual_rig.casting import Chunk, Field, Sight, sight
from endo3d_core.virtual_rig.effects import FULL, Effects
from endo3d_core.virtual_rig.light import Light
from endo3d_core.virtual_rig.profile import FAR_MM
from endo3d_core.virtual_rig.scene import Scene
from endo3d_core.virtual_rig.sensor import Sensor
from endo3d_core.virtual_rig.truth import inside

CHUNK = 24_576
"""Rays at a time: their arrays stay in a core's second-level cache."""

AMBIENT = 0.02
VIGNETTE = 0.4
"""Loss at the edge of the camera's field, beside cos^4."""


class Renderer:
    """One head, one scene. Not for two threads at once."""

    def __init__(
        self,
        rig: Rig,
        head: Head,
        scene: Scene,
        effects: Effects = FULL,
        optics: Sensor | None = None,
        bin_px: int = 1,
    ) -> None:
        self.rig, self.head, self.scene, self.effects = rig, head, scene, effects
        self.camera = rig.camera.binned(bin_px) if bin_px > 1 else rig.camera
        self.sensor = optics or Sensor(bits=8 if effects.quantisation else 16)
        self.circle_px = head.camera_circle_px / bin_px
        where = np.flatnonzero(inside(self.camera, self.camera.pixel_grid(), self.circle_px))
        self.where = where.astype(np.uint32)
        pixels = np.stack((where % self.camera.width, where // self.camera.width), axis=-1)
        rays = self.camera.undistort(pixels)
        self.rx, self.ry = (np.ascontiguousarray(rays[:, k], np.float32) for k in (0, 1))
        self.gain = self._gain()
        self.field = Field(
            self.camera.ray(_circle(self.camera, self.circle_px)),
            rig.projector.ray(_circle(rig.projector, head.projector_circle_px)) @ rig.R,
            rig.projector_centre_mm,
        )
        p = rig.projector
        self._lens = np.array((p.K[0, 0], p.K[0, 1], p.K[0, 2], p.K[1, 1], p.K[1, 2], *p.dist), np.float32)
        self._circle = np.array(
            ((p.width - 1) / 2, (p.height - 1) / 2, (head.projector_circle_px / 2) ** 2), np.float32
        )
        self._R, self._t = rig.R.astype(np.float32), rig.t.astype(np.float32)
        self._centre, self._axis = rig.projector_centre_mm.astype(np.float32), rig.R[2].astype(np.float32)
        self._tiles = [body.material.texture.tile() for body in scene.bodies]
        self._scratch = np.empty((10, CHUNK), np.float32)
        self._body = np.empty(CHUNK, np.uint8)
        self._radiance = np.empty(where.size, np.float32)

    def _gain(self) -> NDArray[np.float32]:
        """(n,) relative illumination of the rays: cos^4 and vignette."""
        if not self.effects.vignetting:
            return np.ones(self.rx.size, np.float32)
        cos2 = 1.0 / (1.0 + self.rx**2 + self.ry**2)
        edge2 = float(np.max(self.rx**2 + self.ry**2))
        return np.asarray(cos2**2 * (1.0 - VIGNETTE * (self.rx**2 + self.ry**2) / edge2), np.float32)

    def radiance(self, light: Light, T_scene_camera: NDArray[np.float64]) -> NDArray[np.float32]:
        """(n,) what the active pixels (``where``) see, 1 = white and fully lit; valid until the next call."""
        poses = [np.linalg.inv(body.T_scene_body) @ T_scene_camera for body in self.scene.bodies]
        sights = [sight(body.shape, T, self.field) for body, T in zip(self.scene.bodies, poses, strict=True)]
        for start in range(0, self.where.size, CHUNK):
            self._shade(slice(start, min(start + CHUNK, self.where.size)), light, sights, poses)
        return self._radiance

    def _shade(
        self, part: slice, light: Light, sights: list[Sight], poses: list[NDArray[np.float64]]
    ) -> None:
        n = part.stop - part.start
        z, nx, ny, nz, lit, u, v, depth, shone, albedo = self._scratch[:, :n]
        rx, ry, out = self.rx[part], self.ry[part], self._radiance[part]
        chunk = Chunk(rx, ry, z, nx, ny, nz, self._body[:n], lit)
        z[:], chunk.body[:], lit[:], out[:] = FAR_MM, 255, 1.0, 0.0
        for index, seen in enumerate(sights):
            seen.cast(chunk, np.uint8(index))
        if self.effects.shadows:
            for seen in sights:
                seen.shadow(chunk)
        shading.to_projector(self._lens, self._circle, self._R, self._t, rx, ry, z, u, v, depth, lit)
        shading.sample(light.samples, light.per_px, u, v, shone)
        ambient = np.float32(AMBIENT if self.effects.ambient else 0.0)
        unit2 = np.float32(self.head.working_distance_mm**2 + (self.head.base_mm / 2) ** 2)
        for index, (body, T) in enumerate(zip(self.scene.bodies, poses, strict=True)):
            surface, which = body.material, np.uint8(index)
            if surface.texture.kind == "none":
                albedo[:] = surface.albedo
            else:
                per_mm = np.float32(1.0 / surface.texture.tile_mm)
                material.paint(
                    T.astype(np.float32), self._tiles[index], per_mm, np.float32(surface.albedo),
                    which, chunk.body, rx, ry, z, albedo,
                )  # fmt: skip
            specular = np.float32(surface.specular if self.effects.specular else 0.0)
            shading.reflect(
                self._centre, self._axis, unit2, ambient, specular, np.float32(surface.gloss),
                rx, ry, z, nx, ny, nz, lit, shone, albedo, chunk.body, which, out,
            )  # fmt: skip

    def frame(
        self,
        light: Light,
        T_scene_camera: NDArray[np.float64],
        exposure_us: float,
        number: int,
        out: NDArray[np.uint8] | NDArray[np.uint16],
    ) -> None:
        """Render into ``out`` (height, width); ``number`` seeds the frame's noise."""
        electrons = self.radiance(light, T_scene_camera)
        electrons *= self.gain * np.float32(self.sensor.flux_e_per_ms * exposure_us * 1e-3)
        out.fill(0)
        sensor.develop(self.sensor, electrons, self.where, number, self.effects.noise, out)


def _circle(lens: Lens, circle_px: float) -> NDArray[np.float64]:
    """(64, 2) pixels on the fibre's rim."""
    angle = np.arange(64) * (2 * math.pi / 64)
    centre = np.array(((lens.width - 1) / 2, (lens.height - 1) / 2))
    return np.asarray(centre + circle_px / 2 * np.stack((np.cos(angle), np.sin(angle)), axis=-1))
