"""The Fourier method as a short complex FIR filter along the row.

Takeda and Mutoh's band-pass (Appl. Opt. 22, 3977, 1983) without a transform: a Gabor of a quarter period,
cut at two sigma, has no wrap-around at the image's edge and sees only 1 period of the neighbourhood.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from endo3d_core.compiled import kernel

SIGMA_PERIODS = 0.25
CUT_SIGMAS = 2.0
TAPS_PER_PASS = 4
"""The loop keeps this many tap pairs in registers; the filter's length is padded to a multiple."""


@dataclass(frozen=True, eq=False)
class Gabor:
    """Turns cos(w x) into exp(i w x): the carrier passes, its mirror frequency is nulled."""

    cosine: NDArray[np.float32]
    """(1 + taps,) centre tap and then one value for both +t and -t."""
    sine: NDArray[np.float32]
    """(1 + taps,) odd: +value at -t, -value at +t; the centre is 0."""

    @property
    def taps(self) -> int:
        """On each side of the centre, padding included."""
        return self.cosine.size - 1

    @property
    def noise_gain(self) -> float:
        """Standard deviation of each part's output per standard deviation of white noise in, averaged over
        both."""
        even = self.cosine[0] ** 2 + 2.0 * np.sum(self.cosine[1:] ** 2)
        return float(np.sqrt(0.5 * (even + 2.0 * np.sum(self.sine**2))))


def gabor(period_px: float) -> Gabor:
    """The filter for a carrier of this period in grid pixels; negative where the phase falls along the
    row."""
    if not abs(period_px) > 3.0:
        raise ValueError(f"fringes of {period_px:.2f} grid pixels are too short to filter: use smaller bins")
    sigma = SIGMA_PERIODS * abs(period_px)
    reach = max(1, int(np.floor(CUT_SIGMAS * sigma)))
    t = np.arange(reach + 1)
    window, omega = np.exp(-0.5 * (t / sigma) ** 2), 2.0 * np.pi / period_px
    even, odd = window * np.cos(omega * t), window * np.sin(omega * t)
    twice = np.where(t == 0, 1.0, 2.0)
    # Equal gains of both parts at the carrier are what nulls the mirror frequency.
    even /= np.sum(twice * even * np.cos(omega * t))
    odd /= np.sum(twice * odd * np.sin(omega * t))
    padded = TAPS_PER_PASS * -(-reach // TAPS_PER_PASS)
    cosine, sine = np.zeros((2, padded + 1), np.float32)
    cosine[: reach + 1], sine[: reach + 1] = even, odd
    return Gabor(cosine, sine)


@kernel
def filter_row(
    padded: NDArray[np.float32],
    cosine: NDArray[np.float32],
    sine: NDArray[np.float32],
    real: NDArray[np.float32],
    imag: NDArray[np.float32],
) -> None:
    """Correlate one row, padded by ``taps`` on both sides, with the filter -> real, imag (width,)."""
    taps, width = cosine.size - 1, real.size
    centre = padded[taps : taps + width]
    c0 = cosine[0]
    for x in range(width):
        real[x] = c0 * centre[x]
        imag[x] = np.float32(0.0)
    for first in range(1, taps + 1, 4):
        c1, c2, c3, c4 = cosine[first], cosine[first + 1], cosine[first + 2], cosine[first + 3]
        s1, s2, s3, s4 = sine[first], sine[first + 1], sine[first + 2], sine[first + 3]
        left = padded[taps - first - 3 : taps - first - 3 + width + 3]
        right = padded[taps + first : taps + first + width + 3]
        for x in range(width):
            r1, r2, r3, r4 = right[x], right[x + 1], right[x + 2], right[x + 3]
            l1, l2, l3, l4 = left[x + 3], left[x + 2], left[x + 1], left[x]
            real[x] += c1 * (r1 + l1) + c2 * (r2 + l2) + c3 * (r3 + l3) + c4 * (r4 + l4)
            imag[x] += s1 * (l1 - r1) + s2 * (l2 - r2) + s3 * (l3 - r3) + s4 * (l4 - r4)
