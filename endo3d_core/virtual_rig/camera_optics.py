"""From the light at the camera's lens to electrons: vignette, defocus, fibre, relay."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from endo3d_core.calibration import Lens
from endo3d_core.head import Head
from endo3d_core.virtual_rig import bundle, defocus
from endo3d_core.virtual_rig.effects import Effects
from endo3d_core.virtual_rig.outline import inside

VIGNETTE = 0.4
"""Loss at the edge of the field, beside cos^4."""
SPOT_PX = 0.8
"""Sigma of a core's image on the unbinned sensor."""
SEED = 1


class CameraOptics:
    """Works on a square of the image that just holds the fibre's circle."""

    def __init__(self, lens: Lens, head: Head, effects: Effects, bin_px: int) -> None:
        self._effects = effects
        circle_px = head.camera_circle_px / bin_px
        # Of the same parity as the image, so that both have the same middle.
        self.width = min(lens.width, 2 * math.ceil(circle_px / 2) + lens.width % 2)
        self.height = min(lens.height, 2 * math.ceil(circle_px / 2) + lens.height % 2)
        left, top = (lens.width - self.width) // 2, (lens.height - self.height) // 2
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        pixels = np.stack((u + left, v + top), axis=-1).astype(np.float64)
        active = inside(lens, pixels, circle_px)
        self._active = np.flatnonzero(active)
        """Flat index in the square of the pixels that see something."""
        rays = lens.undistort(pixels[active])
        self.rx, self.ry = (np.ascontiguousarray(rays[:, k], np.float32) for k in (0, 1))
        """(n,) slopes of the active pixels' rays."""
        self._defocus = defocus.parameters(lens, head, circle_px)
        self._vignette = self._relative_illumination()
        self._bundle = (
            bundle.bundle(self.width, self.height, circle_px, head.camera_pitch_px / bin_px, SPOT_PX / bin_px, SEED)
            if effects.camera_fibre
            else None
        )
        flat = (pixels[..., 1] * lens.width + pixels[..., 0]).astype(np.uint32)
        self.where = np.ascontiguousarray((flat if self._bundle else flat[active]).ravel())
        """Flat index in the image of what ``expose`` returns."""
        self._square = np.zeros((self.height, self.width), np.float32)
        self._variance = np.zeros((self.height, self.width), np.float32)

    def _relative_illumination(self) -> NDArray[np.float32]:
        """(n,) cos^4 and vignette."""
        if not self._effects.vignetting:
            return np.ones(self.rx.size, np.float32)
        slope2 = self.rx**2 + self.ry**2
        return np.asarray((1.0 - VIGNETTE * slope2 / slope2.max()) / (1.0 + slope2) ** 2, np.float32)

    def expose(self, radiance: NDArray[np.float32], depth_mm: NDArray[np.float32]) -> NDArray[np.float32]:
        """(n,) radiance and depth per active pixel -> relative exposure of the pixels ``where``."""
        radiance = radiance * self._vignette
        effects = self._effects
        if not (effects.camera_defocus or effects.camera_fibre):
            return radiance
        square = self._square
        square.reshape(-1)[self._active] = radiance
        if effects.camera_defocus:
            self._variance.reshape(-1)[self._active] = self._blur_variance(depth_mm)
            square = defocus.blur(square, self._variance)
        if self._bundle is None:
            return square.reshape(-1)[self._active]
        return self._bundle.image(self._bundle.transmit(square, effects.crosstalk)).reshape(-1)

    def _blur_variance(self, depth_mm: NDArray[np.float32]) -> NDArray[np.float32]:
        out = np.empty_like(depth_mm)
        defocus.variances(self._defocus, self.rx, self.ry, depth_mm, out)
        return out
