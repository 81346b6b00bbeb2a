"""From photons to millimetres: the 1-sigma of every point.

A grey value of mean g has the variance g / electrons_per_grey + (read noise / electrons_per_grey)^2 + 1/12:
shot noise, read noise, rounding. A bin divides it by its number of pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
    background: NDArray[np.float32],
    modulation: NDArray[np.float32],
    slope: float,
    offset: float,
    gain: float,
    variance: NDArray[np.float32],
) -> None:
    """Phase noise of a filtered normalised signal, all (height, width): gain * sigma_g / (background *
    modulation)."""
    a, b, tiny = np.float32(slope * gain * gain), np.float32(offset * gain * gain), np.float32(1e-6)
    for v in range(variance.shape[0]):
        mean, m, row = background[v], modulation[v], variance[v]
        for x in range(row.size):
            signal = max(mean[x] * m[x], tiny)
            row[x] = (a * mean[x] + b) / (signal * signal)
