"""One pose of the board as both lenses see it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """The same n features in the board's plane, in the camera's image and in the projector's."""

    name: str
    board_mm: NDArray[np.float64]
    """(n, 3) with z = 0."""
    camera_px: NDArray[np.float64]
    """(n, 2)."""
    projector_px: NDArray[np.float64]
    """(n, 2): the projector pixel that lights the feature."""

    def __post_init__(self) -> None:
        n = len(self.board_mm)
        if (
            self.board_mm.shape != (n, 3)
            or self.camera_px.shape != (n, 2)
            or self.projector_px.shape != (n, 2)
        ):
            raise ValueError(f"pose {self.name}: board (n, 3), camera (n, 2) and projector (n, 2) must match")
        if n < 6:
            raise ValueError(f"pose {self.name}: {n} features are too few; at least 6 are needed")
        for name in ("board_mm", "camera_px", "projector_px"):
            if not np.all(np.isfinite(getattr(self, name))):
                raise ValueError(f"pose {self.name}: {name} has values that are not finite")
