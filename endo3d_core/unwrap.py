"""Two wrapped phases -> the absolute phase relative to mid-depth, and which pixels to believe.

Heterodyne unwrapping (Towers, Towers, Jones, Opt. Lett. 28, 887, 2003) of f1 against its beat with f2. Every
phase is taken relative to the pixel's own mid-depth phase, so what is unwrapped is small, and the working
volume is a window around zero.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from endo3d_core.compiled import kernel
from endo3d_core.phase import HALF, PER_TURN, TWO_PI, angle, root, wrap

MODULATION_MIN = 0.125
"""A quarter of the 1/2 that an ideal normalised fringe has."""
BEAT_RESIDUAL_MAX_RAD = 1.0
"""Beat against fringe phase: a wrong order is 2 pi away."""
NEIGHBOUR_MAX_RAD = 0.6
"""Against the nominal carrier, between grid neighbours: a steeper surface is an edge."""


@kernel
def unwrap_row(
    first: NDArray[np.int16],
    second: NDArray[np.int16],
    third: NDArray[np.int16],
    fourth: NDArray[np.int16],
    unit: float,
    carrier: NDArray[np.float32],
    f1: float,
    f2: float,
    modulation_min: float,
    phase: NDArray[np.float32],
    modulation: NDArray[np.float32],
    residual: NDArray[np.float32],
) -> None:
    """Phasors (2, width) of a row -> phase of f1 relative to mid-depth, rad; NaN where it can't be trusted.

    f1's phasor is the mean of ``first`` and ``second``, f2's of ``third`` and ``fourth``, all in ``unit``.
    ``carrier`` is the mid-depth phase of f1. ``modulation`` is the weaker phasor's, ``residual`` the beat's
    disagreement in rad of f1. All rows (width,).
    """
    ratio, beat_share = np.float32(f1 / (f1 - f2)), np.float32((f1 - f2) / f1)
    half_unit, most, nan = np.float32(0.5 * unit), np.float32(BEAT_RESIDUAL_MAX_RAD), np.float32(np.nan)
    least = np.float32((2.0 * modulation_min / unit) ** 2)
    a_re, a_im, b_re, b_im = first[0], first[1], second[0], second[1]
    c_re, c_im, d_re, d_im = third[0], third[1], fourth[0], fourth[1]
    for x in range(phase.size):
        re1, im1 = np.float32(a_re[x]) + np.float32(b_re[x]), np.float32(a_im[x]) + np.float32(b_im[x])
        re2, im2 = np.float32(c_re[x]) + np.float32(d_re[x]), np.float32(c_im[x]) + np.float32(d_im[x])
        fine = wrap(angle(im1, re1) - carrier[x])
        beat = wrap(angle(im1 * re2 - re1 * im2, re1 * re2 + im1 * im2) - beat_share * carrier[x])
        coarse = ratio * beat
        order = np.floor((coarse - fine) * PER_TURN + HALF)
        e = fine + TWO_PI * order
        power = min(re1 * re1 + im1 * im1, re2 * re2 + im2 * im2)
        trusted = (abs(coarse - e) < most) & (power > least)
        phase[x] = e if trusted else nan
        residual[x] = abs(coarse - e)
        modulation[x] = half_unit * root(power)


@kernel
def keep_smooth_row(
    above: NDArray[np.float32],
    here: NDArray[np.float32],
    below: NDArray[np.float32],
    limit_rad: float,
    out: NDArray[np.float32],
) -> None:
    """Phases of three rows -> the middle one's, NaN where one of the four neighbours is invalid or beyond the limit.

    Kills what is left of wrong orders: they stand alone at edges.
    """
    limit, nan, last = np.float32(limit_rad), np.float32(np.nan), here.size - 1
    left, middle, right = here[: last - 1], here[1:last], here[2:]
    upper, lower, inner = above[1:last], below[1:last], out[1:last]
    out[0] = nan
    out[last] = nan
    for x in range(inner.size):
        e = middle[x]
        agree = (abs(left[x] - e) < limit) & (abs(right[x] - e) < limit)
        agree &= (abs(upper[x] - e) < limit) & (abs(lower[x] - e) < limit)
        inner[x] = e if agree else nan
