"""Frames -> normalised samples and their phasors: what the continuous mode keeps of every frame.

Both are kept as 16-bit fixed point: a step moves more bytes than it computes, and the rounding is a thirtieth of the
noise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from endo3d_core.bandpass import filter_row
from endo3d_core.binning import Grid
from endo3d_core.compiled import kernel
from endo3d_core.phase import reciprocal

SAMPLE_UNIT = 1.0 / 32768.0
"""Samples lie within +-1. They are odd multiples of it: 0 stands for none."""
PHASOR_UNIT = 1.0 / 16384.0


class Normalisation(NamedTuple):
    """s = gain (plus - share minus) / (before + middle centre + after) - offset."""

    share: float
    gain: float
    offset: float
    middle: float


PUBLISHED_OWN = Normalisation(0.0, 1.0, 0.5, 0.0)
"""(g[k] - a) / 2a with a = (g[k-1] + g[k+1]) / 2: eq. (6), corrected to the mean."""
PUBLISHED_PAIR = Normalisation(1.0, 0.5, 0.0, 0.0)
"""(g[k-1] - g[k+1]) / 4a with the same a: eq. (5)."""
SYMMETRIC_OWN = Normalisation(0.0, 2.0, 0.5, 2.0)
"""(g[k] - a) / 2a with a = (g[k-2] + 2 g[k] + g[k+2]) / 4: symmetric in time."""
SYMMETRIC_PAIR = Normalisation(1.0, 1.0, 0.0, 2.0)
"""(g[k-1] - g[k+1]) / 4a with the same a."""


@kernel
def normalise(
    plus: Grid,
    minus: Grid,
    before: Grid,
    centre: Grid,
    after: Grid,
    form: Normalisation,
    sign: float,
    dark: float,
    saturation: float,
    average: int,
    cosine: NDArray[np.float32],
    sine: NDArray[np.float32],
    padded: NDArray[np.float32],
    scratch: NDArray[np.float32],
    samples: NDArray[np.int16],
    phasors: NDArray[np.int16],
) -> None:
    """Five grids (height, width) -> samples (height, width), phasors (height, 2, width / average).

    The filter sees means of ``average`` columns. Where the mean of the grids is not between ``dark`` and
    ``saturation``, the sample is 0. ``samples`` of size 0 are not kept. Scratch: ``padded`` (filter's length more than
    the phasors' width), ``scratch`` (3, width).
    """
    share, gain, offset, middle = (
        np.float32(form.share), np.float32(sign * form.gain), np.float32(sign * form.offset), np.float32(form.middle)
    )  # fmt: skip
    least, most = np.float32(dark) * (np.float32(2.0) + middle), np.float32(saturation) * (np.float32(2.0) + middle)
    zero, taps, columns = np.float32(0.0), cosine.size - 1, phasors.shape[2]
    row, real, imag = scratch[0], scratch[1, :columns], scratch[2, :columns]
    inner = padded[taps : taps + columns]
    for v in range(plus.shape[0]):
        p, m, b, c, a = plus[v], minus[v], before[v], centre[v], after[v]
        for x in range(row.size):
            total = np.float32(b[x]) + middle * np.float32(c[x]) + np.float32(a[x])
            value = gain * (np.float32(p[x]) - share * np.float32(m[x])) * reciprocal(total) - offset
            row[x] = value if (total > least) & (total < most) else zero
        if samples.size > 0:
            _keep_samples(row, samples[v])
        average_row(row, average, inner)
        filter_row(padded, cosine, sine, real, imag)
        _keep_phasors(real, phasors[v, 0])
        _keep_phasors(imag, phasors[v, 1])


@kernel
def _keep_samples(row: NDArray[np.float32], kept: NDArray[np.int16]) -> None:
    steps, one, two, zero = np.float32(0.5 / SAMPLE_UNIT), np.float32(1.0), np.float32(2.0), np.float32(0.0)
    low, high = np.float32(-0.99), np.float32(0.99)
    for x in range(row.size):
        value = row[x]
        odd = two * np.floor(min(max(value, low), high) * steps) + one
        kept[x] = np.int16(np.int32(odd if value != zero else zero))


@kernel
def _keep_phasors(row: NDArray[np.float32], kept: NDArray[np.int16]) -> None:
    steps, half = np.float32(1.0 / PHASOR_UNIT), np.float32(0.5)
    for x in range(row.size):
        kept[x] = np.int16(np.int32(np.floor(row[x] * steps + half)))


@kernel
def average_row(row: NDArray[np.float32], columns: int, out: NDArray[np.float32]) -> None:
    """(width,) -> (width / columns,) means; columns is 1, 2 or 4."""
    half, quarter = np.float32(0.5), np.float32(0.25)
    if columns == 1:
        for x in range(out.size):
            out[x] = row[x]
    elif columns == 2:
        for x in range(out.size):
            out[x] = half * (row[2 * x] + row[2 * x + 1])
    else:
        for x in range(out.size):
            out[x] = quarter * ((row[4 * x] + row[4 * x + 1]) + (row[4 * x + 2] + row[4 * x + 3]))
