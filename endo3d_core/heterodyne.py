"""Heterodyne unwrapping over any number of frequencies, and their weighted mean.

Each beat of the first frequency with another one unwraps the next finer beat, the last one the first frequency
itself (Towers, Towers, Jones, Opt. Lett. 28, 887, 2003). Every phase is relative to the pixel's mid-depth phase, so
what is unwrapped is small.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from endo3d_core.compiled import kernel
from endo3d_core.phase import HALF, PER_TURN, TWO_PI, angle, wrap

RESIDUAL_MAX = 0.8
"""Of half a period, between two rungs of the chain."""


class Chain(NamedTuple):
    """Which frequencies, and in which order they unwrap each other."""

    frequencies: NDArray[np.float32]
    beat_with: NDArray[np.int64]
    """(frequencies - 1,) the one that the first beats with, widest beat first."""
    beats: NDArray[np.float32]
    weights: NDArray[np.float32]
    """(frequencies,) of the phases in the result; their sum is 1."""


@kernel
def wrap_rows(
    components: NDArray[np.float32],
    frequencies: NDArray[np.float32],
    carrier: NDArray[np.float32],
    wrapped: NDArray[np.float32],
) -> None:
    """Components (1 + 2 n, width) -> phases relative to mid-depth (n, width); ``carrier`` is that of f_1."""
    for i in range(frequencies.size):
        c, s, w = components[1 + 2 * i], components[2 + 2 * i], wrapped[i]
        share = frequencies[i] / frequencies[0]
        for x in range(carrier.size):
            w[x] = wrap(angle(s[x], c[x]) - share * carrier[x])


@kernel
def unwrap_row(
    wrapped: NDArray[np.float32], chain: Chain, phase: NDArray[np.float32], residual: NDArray[np.float32]
) -> None:
    """Wrapped phases (n, width) -> phase of f_1, rad, and the worst disagreement in the chain, of half a period.

    A single frequency is taken as it is: good for depths within one fringe.
    """
    fine = wrapped[0]
    if chain.beats.size == 0:
        for x in range(phase.size):
            phase[x], residual[x] = fine[x], np.float32(0.0)
        return
    known = chain.beats[0]
    other = wrapped[chain.beat_with[0]]
    for x in range(phase.size):
        phase[x], residual[x] = wrap(fine[x] - other[x]), np.float32(0.0)
    for j in range(1, chain.beats.size):
        other = wrapped[chain.beat_with[j]]
        gain, known = chain.beats[j] / known, chain.beats[j]
        for x in range(phase.size):
            value = wrap(fine[x] - other[x])
            off = (gain * phase[x] - value) * PER_TURN
            order = np.floor(off + HALF)
            residual[x] = max(residual[x], abs(off - order))
            phase[x] = value + TWO_PI * order
    gain, two = chain.frequencies[0] / known, np.float32(2.0)
    for x in range(phase.size):
        off = (gain * phase[x] - fine[x]) * PER_TURN
        order = np.floor(off + HALF)
        residual[x] = two * max(residual[x], abs(off - order))
        phase[x] = fine[x] + TWO_PI * order


@kernel
def average_phases(
    wrapped: NDArray[np.float32], chain: Chain, phase: NDArray[np.float32], mean: NDArray[np.float32]
) -> None:
    """The phase of f_1 unwraps all others; their weighted mean, in rad of f_1 -> mean (width,)."""
    f1, weight = chain.frequencies[0], chain.weights[0]
    for x in range(phase.size):
        mean[x] = weight * phase[x]
    for i in range(1, chain.frequencies.size):
        w, share = wrapped[i], chain.frequencies[i] / f1
        gain = chain.weights[i] / share
        for x in range(phase.size):
            expected = share * phase[x]
            mean[x] += gain * (expected + wrap(w[x] - expected))
