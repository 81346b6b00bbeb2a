"""Two wrapped phases -> the absolute phase relative to mid-depth, and which pixels to believe.

Heterodyne unwrapping (Towers, Towers, Jones, Opt. Lett. 28, 887, 2003) of f1 against its beat with f2. Every
phase is taken relative to the pixel's own mid-depth phase, so what is unwrapped is small, and the working
volume is a window around zero.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from endo3d_core.compiled import kernel
from endo3d_core.phase import HALF, ONE, PER_TURN, TWO_PI, ZERO, angle, wrap

MODULATION_MIN = 0.125
"""A quarter of the 1/2 that an ideal normalised fringe has."""
BEAT_RESIDUAL_MAX_RAD = 1.0
"""Beat against fringe phase: a wrong order is 2 pi away."""
NEIGHBOUR_MAX_RAD = 0.6
"""Against the nominal carrier, between grid neighbours: a steeper surface is an edge."""


@kernel
def beat_unwrap(
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    third: NDArray[np.float32],
    fourth: NDArray[np.float32],
    carrier_rad: NDArray[np.float32],
    f1: float,
    f2: float,
    modulation_min: float,
    phase: NDArray[np.float32],
    modulation: NDArray[np.float32],
    residual: NDArray[np.float32],
) -> None:
    """Phasors (2, height, width) -> phase of f1 relative to mid-depth, rad; NaN where it can't be trusted.

    f1's phasor is the mean of ``first`` and ``second``, f2's of ``third`` and ``fourth``. ``carrier_rad``
    is the mid-depth phase of f1. ``modulation`` is the weaker phasor's, ``residual`` the beat's
    disagreement in rad of f1: both (height, width).
    """
    ratio, beat_share = np.float32(f1 / (f1 - f2)), np.float32((f1 - f2) / f1)
    least, most = np.float32(4.0 * modulation_min * modulation_min), np.float32(BEAT_RESIDUAL_MAX_RAD)
    nan = np.float32(np.nan)
    for v in range(phase.shape[0]):
        a_re, a_im, b_re, b_im = first[0, v], first[1, v], second[0, v], second[1, v]
        c_re, c_im, d_re, d_im = third[0, v], third[1, v], fourth[0, v], fourth[1, v]
        carrier, e_row, m_row, r_row = carrier_rad[v], phase[v], modulation[v], residual[v]
        for x in range(e_row.size):
            re1, im1 = a_re[x] + b_re[x], a_im[x] + b_im[x]
            re2, im2 = c_re[x] + d_re[x], c_im[x] + d_im[x]
            fine = wrap(angle(im1, re1) - carrier[x])
            beat = wrap(angle(im1 * re2 - re1 * im2, re1 * re2 + im1 * im2) - beat_share * carrier[x])
            coarse = ratio * beat
            order = np.floor((coarse - fine) * PER_TURN + HALF)
            e = fine + TWO_PI * order
            power = min(re1 * re1 + im1 * im1, re2 * re2 + im2 * im2)
            trusted = (abs(coarse - e) < most) & (power > least)
            e_row[x] = e if trusted else nan
            r_row[x] = abs(coarse - e)
            m_row[x] = HALF * np.sqrt(power)


@kernel
def keep_smooth(phase: NDArray[np.float32], limit_rad: float, out: NDArray[np.float32]) -> None:
    """phase -> out (height, width), NaN where one of the four neighbours is invalid or further than the
    limit.

    Kills what is left of wrong orders: they stand alone at edges.
    """
    limit, nan = np.float32(limit_rad), np.float32(np.nan)
    height, width = phase.shape
    out[0] = nan
    out[height - 1] = nan
    for v in range(1, height - 1):
        above, here, below, row = phase[v - 1], phase[v], phase[v + 1], out[v]
        row[0] = nan
        row[width - 1] = nan
        for x in range(1, width - 1):
            e = here[x]
            agree = (abs(here[x - 1] - e) < limit) & (abs(here[x + 1] - e) < limit)
            agree &= (abs(above[x] - e) < limit) & (abs(below[x] - e) < limit)
            row[x] = e if agree else nan


@kernel
def grade(modulation: NDArray[np.float32], residual: NDArray[np.float32], quality: NDArray[np.float32]) -> None:
    """Quality 0..1: modulation against the ideal 1/2, less the beat's disagreement."""
    for v in range(quality.shape[0]):
        m, r, row = modulation[v], residual[v], quality[v]
        for x in range(row.size):
            row[x] = min(m[x] + m[x], ONE) * max(ONE - r[x], ZERO)
