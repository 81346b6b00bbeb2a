"""From photons to millimetres: the 1-sigma of every point.

A grey value of mean g has the variance g / electrons_per_grey + (read noise / electrons_per_grey)^2 + 1/12:
shot noise, read noise, rounding. A bin divides it by its number of pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from endo3d_core.compiled import kernel

ROUNDING = 1.0 / 12.0


@dataclass(frozen=True, slots=True)
class Sensor:
    """A camera's noise; the defaults are the Sony IMX174's at 8 bit (32 ke- full well, 7 e- read noise)."""

    electrons_per_grey: float = 125.5
    read_noise_electrons: float = 7.0

    def variance(self, bin_px: int) -> tuple[float, float]:
        """(slope, offset) of a bin's grey value variance over its mean grey value."""
        pixels = bin_px * bin_px
        read = (self.read_noise_electrons / self.electrons_per_grey) ** 2
        return 1.0 / self.electrons_per_grey / pixels, (read + ROUNDING) / pixels


IMX174 = Sensor()


@kernel
def bandpass_variance(
    background: np.float32, modulation: np.float32, slope: np.float32, offset: np.float32
) -> np.float32:
    """Phase variance of a filtered normalised signal, rad^2: (slope background + offset) / (background modulation)^2.

    ``slope`` and ``offset`` are the grey values' times the square of the filter's noise gain.
    """
    signal = max(background * modulation, np.float32(1e-6))
    return (slope * background + offset) / (signal * signal)
