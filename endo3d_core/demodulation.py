"""Grey values -> background and fringes of every frequency, as weights.

A pattern of frequency f and shift s is g = a + C_f cos s - S_f sin s with (C_f, S_f) = b (cos phi_f, sin phi_f). All
patterns share the background a, so two shifts are enough for the lower frequencies (Peng and Gupta); the least-squares
solution of all patterns together is the symmetric n-step formula where a frequency has n steps.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from endo3d_core.patterns import Pattern


def demodulation(patterns: tuple[Pattern, ...], frequencies: tuple[float, ...]) -> NDArray[np.float64]:
    """(1 + 2 frequencies, patterns): weights that turn grey values into a, C_1, S_1, C_2, S_2, ...

    Raises ``ValueError`` when the shifts can't tell them apart.
    """
    design = np.zeros((len(patterns), 1 + 2 * len(frequencies)))
    design[:, 0] = 1.0
    for row, pattern in zip(design, patterns, strict=True):
        column = 1 + 2 * frequencies.index(pattern.frequency)
        row[column : column + 2] = math.cos(pattern.shift_rad), -math.sin(pattern.shift_rad)
    if np.linalg.matrix_rank(design, tol=1e-6) < design.shape[1]:
        raise ValueError(
            f"{len(patterns)} patterns can't tell the background and {len(frequencies)} phases apart: "
            "three shifts of the first frequency and two of each other are needed"
        )
    return np.asarray(np.linalg.pinv(design))


def unwrapping_chain(frequencies: tuple[float, ...]) -> list[tuple[int, float]]:
    """(index of the frequency that the first one beats with, beat), widest beat first.

    A beat of b periods is unique over 1/b of the projector; each beat unwraps the next, the last unwraps f_1.
    """
    beats = [(i, frequencies[0] - f) for i, f in enumerate(frequencies) if i > 0]
    return sorted(beats, key=lambda item: abs(item[1]))


def phase_variances(weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """(frequencies,) variance of each fringe component per variance of a grey value."""
    return np.asarray((weights[1::2] ** 2 + weights[2::2] ** 2).sum(axis=1) / 2.0)


def phase_weights(weights: NDArray[np.float64], frequencies: tuple[float, ...]) -> NDArray[np.float64]:
    """(frequencies,) weights of each phase, in rad of f_1, in the best estimate of f_1's; their sum is 1.

    Inverse variances for white noise: a phase of f_i has f_i / f_1 of the slope and its own number of steps.
    """
    information = (np.array(frequencies) / frequencies[0]) ** 2 / phase_variances(weights)
    return np.asarray(information / information.sum())


class Groups(NamedTuple):
    """The patterns of each frequency in groups of at most four: what the demodulating loop adds up at once.

    A frequency of three steps or more has a background of its own; one of two steps shares the first's.
    """

    frequency: NDArray[np.int64]
    """(groups,) which one."""
    fresh: NDArray[np.bool_]
    """(groups,) the first of its frequency."""
    pair: NDArray[np.bool_]
    """(groups,) two patterns only, sharing the first frequency's background."""
    patterns: NDArray[np.int64]
    """(groups, 4) indices; a group that is not full repeats its first with weight 0."""
    weights: NDArray[np.float32]
    """(groups, 3, 4): of a, C, S."""
    shared: NDArray[np.float32]
    """(groups, 2) weights of the first frequency's a in C and S of a pair."""


def groups(patterns: tuple[Pattern, ...], frequencies: tuple[float, ...]) -> Groups:
    """Peng and Gupta's least squares, frequency by frequency."""
    rows: list[tuple[int, bool, bool, list[int], NDArray[np.float32], NDArray[np.float32]]] = []
    for i, f in enumerate(frequencies):
        own = [k for k, pattern in enumerate(patterns) if pattern.frequency == f]
        shifts = np.array([patterns[k].shift_rad for k in own])
        design = np.stack((np.ones(len(own)), np.cos(shifts), -np.sin(shifts)), axis=1)
        solution, pair = np.zeros((3, len(own))), np.linalg.matrix_rank(design, tol=1e-6) < 3
        if pair:
            solution[1:] = np.linalg.pinv(design[:, 1:])
        else:
            solution[:] = np.linalg.pinv(design)
        size = 2 if pair else 4
        for start in range(0, len(own), size):
            members = own[start : start + size]
            four = np.zeros((3, 4), np.float32)
            four[:, : len(members)] = solution[:, start : start + size]
            shared = -four[1:].sum(axis=1) if pair else np.zeros(2, np.float32)
            rows.append((i, start == 0, pair, members + members[:1] * (4 - len(members)), four, shared))
    frequency, fresh, pairs, indices, weights, backgrounds = zip(*rows, strict=True)
    return Groups(
        np.array(frequency), np.array(fresh), np.array(pairs), np.array(indices), np.stack(weights),
        np.stack(backgrounds),
    )  # fmt: skip
