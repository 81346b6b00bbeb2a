"""The points at which a camera really sees: its pixels, or the cores of the fibre in front of it.

Calibration works on these samples and never on an interpolated image: between two cores nothing was measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from endo3d_core.fibre import CoreMap

Image = NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float32] | NDArray[np.float64]

SPOT = 0.3
"""Sigma of the average over a core, of the cores' spacing."""
GAIN_LEAST = 0.1
"""Of the median: darker cores only amplify noise."""
BIN_PX = 2
"""Pixels per side of a sample without a fibre."""
COLUMNS = 256
"""cv2.remap takes tables of less than 32768 rows and columns."""


class Retina(Protocol):
    """What samples an image."""

    points: NDArray[np.float64]
    """(n, 2) px."""
    spacing_px: float
    """Of neighbouring samples."""

    def sample(self, image: Image) -> NDArray[np.float32]:
        """(height, width) -> (n,) grey values."""

    def even(self, samples: NDArray[np.float32]) -> NDArray[np.float32]:
        """(n,) without the samples' own gains."""

    def picture(self, image: Image) -> NDArray[np.uint8]:
        """(height, width) uint8 for eyes and board finders: without honeycomb, white at 200."""

    @property
    def tree(self) -> cKDTree:
        """Of the points."""


@dataclass(eq=False)
class PixelRetina:
    """A camera without a fibre: means over small squares of pixels."""

    width: int
    height: int

    def __post_init__(self) -> None:
        v, u = np.mgrid[0 : self.height // BIN_PX, 0 : self.width // BIN_PX]
        self.points = (np.stack((u.ravel(), v.ravel()), axis=-1) + 0.5) * BIN_PX - 0.5
        self.spacing_px = float(BIN_PX)

    @cached_property
    def tree(self) -> cKDTree:
        return cKDTree(self.points)

    def sample(self, image: Image) -> NDArray[np.float32]:
        rows, columns = self.height // BIN_PX, self.width // BIN_PX
        cut = image[: rows * BIN_PX, : columns * BIN_PX].astype(np.float32)
        return np.asarray(cut.reshape(rows, BIN_PX, columns, BIN_PX).mean(axis=(1, 3)).ravel())

    def even(self, samples: NDArray[np.float32]) -> NDArray[np.float32]:
        return samples

    def picture(self, image: Image) -> NDArray[np.uint8]:
        return _white_at_200(image.astype(np.float32))


class FibreRetina:
    """A camera behind an imaging fibre: one sample per core."""

    def __init__(self, core_map: CoreMap) -> None:
        self.points, self.spacing_px = core_map.cores, core_map.spacing_px
        at = np.zeros((-(-len(self.points) // COLUMNS) * COLUMNS, 2), np.float32)
        at[: len(self.points)] = self.points
        self._u, self._v = (np.ascontiguousarray(at[:, k].reshape(-1, COLUMNS)) for k in (0, 1))
        self._flat = cv2.GaussianBlur(core_map.flat, (0, 0), self.spacing_px / 2)
        gain = self.sample(core_map.flat)
        self.gain = np.maximum(gain, GAIN_LEAST * np.median(gain))

    @cached_property
    def tree(self) -> cKDTree:
        return cKDTree(self.points)

    def sample(self, image: Image) -> NDArray[np.float32]:
        spots = cv2.GaussianBlur(image.astype(np.float32), (0, 0), SPOT * self.spacing_px)
        cores = cv2.remap(spots, self._u, self._v, cv2.INTER_CUBIC)
        return np.asarray(cores.ravel()[: len(self.points)], np.float32)

    def even(self, samples: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(samples / self.gain)

    def picture(self, image: Image) -> NDArray[np.uint8]:
        blurred = cv2.GaussianBlur(image.astype(np.float32), (0, 0), self.spacing_px / 2)
        lit = self._flat > GAIN_LEAST * np.percentile(self._flat, 99)
        return _white_at_200(np.where(lit, blurred / np.maximum(self._flat, 1e-3), 0.0))


def _white_at_200(grey: NDArray[np.floating]) -> NDArray[np.uint8]:
    white = np.percentile(grey[grey > 0], 95) if np.any(grey > 0) else 1.0
    return np.asarray(np.clip(grey * (200.0 / white), 0, 255), np.uint8)
