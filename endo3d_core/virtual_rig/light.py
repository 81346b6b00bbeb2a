"""What leaves the projector: patterns as light over its pixels, in and out of focus."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from endo3d_core.calibration import Rig
from endo3d_core.head import Head
from endo3d_core.virtual_rig import bundle, defocus
from endo3d_core.virtual_rig.effects import Effects

LEVELS = 7
LEVEL_STEP = 0.05
"""Of the working distance: how far out of focus one level is from the next."""
SEED = 2


@dataclass(frozen=True, eq=False)
class Light:
    """Irradiance 0..1 over the projector's pixels; an axis along which nothing varies has one sample."""

    samples: NDArray[np.float32]
    """(levels, rows, columns): level k is what arrives k steps out of focus."""
    per_px: NDArray[np.float32]
    """(4,) samples per projector pixel along u and v, and the index of pixel 0 along u and v."""


def ideal(image: NDArray[np.uint8], gamma: float = 1.0) -> Light:
    """A pattern image (rows, columns) as the DMD shows it; ``gamma`` is the projector's."""
    per_px = np.array((1.0, 1.0, 0.0, 0.0), np.float32)
    if (image == image[:1]).all():
        image, per_px[1] = image[:1], 0.0
    if (image == image[:, :1]).all():
        image, per_px[0] = image[:, :1], 0.0
    return Light(((image / np.float32(255.0)) ** np.float32(gamma)).astype(np.float32)[None], per_px)


class ProjectorOptics:
    """Fibre and lens of the projector: pattern images to light."""

    def __init__(self, rig: Rig, head: Head, effects: Effects) -> None:
        self._effects = effects
        window = rig.projector
        pitch = head.projector_pitch_px
        spot = bundle.CORE_WIDTH / 4 * pitch  # the standard deviation of a disc is half its radius
        self._bundle = (
            bundle.bundle(window.width, window.height, head.projector_circle_px, pitch, spot, SEED)
            if effects.projector_fibre
            else None
        )
        off_mm = LEVEL_STEP * head.working_distance_mm * np.arange(LEVELS)
        sigma_mm = np.hypot(defocus.sigma0_mm(head), head.defocus_per_mm * off_mm)
        self._sigmas_px = sigma_mm * window.K[0, 0] / defocus.focus_mm(head)

    def light(self, image: NDArray[np.uint8], gamma: float = 1.0) -> Light:
        """What a pattern image (rows, columns) becomes."""
        shown = ideal(image, gamma)
        if self._bundle is None and not self._effects.projector_defocus:
            return shown
        full = np.ascontiguousarray(np.broadcast_to(shown.samples[0], image.shape))
        if self._bundle is not None:
            full = self._bundle.image(self._bundle.transmit(full, self._effects.crosstalk))
        if not self._effects.projector_defocus:
            return Light(full[None], np.array((1.0, 1.0, 0.0, 0.0), np.float32))
        levels = [defocus.gaussian(full, float(sigma_px)) for sigma_px in self._sigmas_px]
        return Light(np.stack(levels), np.array((1.0, 1.0, 0.0, 0.0), np.float32))
