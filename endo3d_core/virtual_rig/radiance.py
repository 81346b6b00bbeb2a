"""What every pixel of the camera sees of a scene under a light: rays, surfaces, projector, reflection."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from endo3d_core.calibration import Rig
from endo3d_core.head import Head
from endo3d_core.virtual_rig import defocus, material, shading
from endo3d_core.virtual_rig.casting import Chunk, Field, Sight, sight
from endo3d_core.virtual_rig.effects import Effects
from endo3d_core.virtual_rig.light import LEVEL_STEP, Light
from endo3d_core.virtual_rig.outline import rim
from endo3d_core.virtual_rig.profile import FAR_MM
from endo3d_core.virtual_rig.scene import Scene

CHUNK = 24_576
"""Rays at a time: their arrays stay in a core's second-level cache."""
AMBIENT = 0.02
"""Of the projector's full light, from everywhere."""

Pose = NDArray[np.float64]


class Radiance:
    """One head, one scene, the rays (rx, ry, 1) of n pixels."""

    def __init__(
        self,
        rig: Rig,
        head: Head,
        scene: Scene,
        effects: Effects,
        rays: tuple[NDArray[np.float32], NDArray[np.float32]],
        threads: int = 1,
    ) -> None:
        self._head, self._scene, self._effects = head, scene, effects
        self._rx, self._ry = rays
        p = rig.projector
        self._lens = np.array((p.K[0, 0], p.K[0, 1], p.K[0, 2], p.K[1, 1], p.K[1, 2], *p.dist), np.float32)
        middle = ((p.width - 1) / 2, (p.height - 1) / 2)
        self._circle = np.array((*middle, (head.projector_circle_px / 2) ** 2), np.float32)
        self._R, self._t = rig.R.astype(np.float32), rig.t.astype(np.float32)
        self._centre, self._axis = rig.projector_centre_mm.astype(np.float32), rig.R[2].astype(np.float32)
        self._unit2 = np.float32(defocus.focus_mm(head) ** 2)
        self._focus = np.array(
            (
                defocus.focus_mm(head),
                defocus.bow_mm(head, p, head.projector_circle_px),
                1.0 / (LEVEL_STEP * head.working_distance_mm),
            ),
            np.float32,
        )
        self._field = Field(
            rim(rig.camera, head.camera_circle_px),
            rim(p, head.projector_circle_px) @ rig.R,
            rig.projector_centre_mm,
        )
        self._tiles = [body.material.texture.tile() for body in scene.bodies]
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None
        self._scratch = np.empty((threads, 9, CHUNK), np.float32)
        self._bodies = np.empty((threads, CHUNK), np.uint8)

    def of(self, light: Light, T_scene_camera: Pose, radiance: NDArray[np.float32], depth: NDArray[np.float32]) -> None:
        """Fill (n,) radiance, 1 = white and fully lit, and (n,) depth in mm."""
        poses = [np.linalg.inv(body.T_scene_body) @ T_scene_camera for body in self._scene.bodies]
        sights = [sight(body.shape, T, self._field) for body, T in zip(self._scene.bodies, poses, strict=True)]
        threads = len(self._scratch)

        def share(thread: int) -> None:
            for start in range(thread * CHUNK, self._rx.size, threads * CHUNK):
                part = slice(start, min(start + CHUNK, self._rx.size))
                self._shade(thread, part, light, sights, poses, radiance[part], depth[part])

        if self._pool is None:
            share(0)
        else:
            list(self._pool.map(share, range(threads)))

    def _shade(
        self,
        thread: int,
        part: slice,
        light: Light,
        sights: list[Sight],
        poses: list[Pose],
        out: NDArray[np.float32],
        z: NDArray[np.float32],
    ) -> None:
        n = z.size
        nx, ny, nz, lit, u, v, depth, shone, albedo = self._scratch[thread, :, :n]
        rx, ry = self._rx[part], self._ry[part]
        chunk = Chunk(rx, ry, z, nx, ny, nz, self._bodies[thread, :n], lit)
        z[:], chunk.body[:], lit[:], out[:] = FAR_MM, 255, 1.0, 0.0
        for index, seen in enumerate(sights):
            seen.cast(chunk, np.uint8(index))
        if self._effects.shadows:
            for seen in sights:
                seen.shadow(chunk)
        shading.to_projector(self._lens, self._circle, self._R, self._t, rx, ry, z, u, v, depth, lit)
        if len(light.samples) > 1:
            shading.sample_levels(light.samples, light.per_px, self._lens, self._focus, u, v, depth, shone)
        else:
            shading.sample(light.samples[0], light.per_px, u, v, shone)
        ambient = np.float32(AMBIENT if self._effects.ambient else 0.0)
        for index, (body, T) in enumerate(zip(self._scene.bodies, poses, strict=True)):
            surface, which = body.material, np.uint8(index)
            self._paint(index, T.astype(np.float32), chunk, albedo)
            specular = np.float32(surface.specular if self._effects.specular else 0.0)
            shading.reflect(
                self._centre, self._axis, self._unit2, ambient, specular, np.float32(surface.gloss),
                rx, ry, z, nx, ny, nz, lit, shone, albedo, chunk.body, which, out,
            )  # fmt: skip

    def _paint(self, index: int, T: NDArray[np.float32], chunk: Chunk, albedo: NDArray[np.float32]) -> None:
        surface = self._scene.bodies[index].material
        if surface.texture.kind == "none":
            albedo[:] = surface.albedo
            return
        per_mm = np.float32(1.0 / surface.texture.tile_mm)
        material.paint(
            T, self._tiles[index], per_mm, np.float32(surface.albedo),
            np.uint8(index), chunk.body, chunk.rx, chunk.ry, chunk.z, albedo,
        )  # fmt: skip
