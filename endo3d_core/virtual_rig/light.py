"""What leaves the projector: the pattern as light, per projector pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Light:
    """Irradiance 0..1 over the projector's pixels; an axis along which nothing varies has one sample."""

    samples: NDArray[np.float32]
    """(rows, columns)."""
    per_px: NDArray[np.float32]
    """(4,) samples per projector pixel along u and v, and the index of pixel 0 along u and v."""


def ideal(image: NDArray[np.uint8], gamma: float = 1.0) -> Light:
    """A pattern image (rows, columns) as the DMD shows it; ``gamma`` is the projector's."""
    per_px = np.array((1.0, 1.0, 0.0, 0.0), np.float32)
    if (image == image[:1]).all():
        image, per_px[1] = image[:1], 0.0
    if (image == image[:, :1]).all():
        image, per_px[0] = image[:, :1], 0.0
    return Light(((image / np.float32(255.0)) ** np.float32(gamma)).astype(np.float32), per_px)
