"""The conventional mode: phase shifting per pixel, heterodyne unwrapping over the frequencies (section 3.1).

A pattern of frequency f and shift s is g = a + C_f cos s - S_f sin s with (C_f, S_f) = b (cos phi_f, sin
phi_f). All patterns share the background a, so two shifts are enough for the lower frequencies (Peng and
Gupta); the least-squares solution of all patterns together is the symmetric n-step formula where a
frequency has n steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d_core import triangulation
from endo3d_core.binning import Image, bin_image
from endo3d_core.compiled import kernel
from endo3d_core.hdr import fuse_row
from endo3d_core.patterns import Pattern, PatternSet
from endo3d_core.phase import HALF, PER_TURN, TWO_PI, angle, wrap
from endo3d_core.triangulation import Lookup
from endo3d_core.uncertainty import IMX174, Sensor

STRIP = 480
"""Columns at a time."""
MODULATION_MIN = 0.1
"""Least fringe contrast b/a of the first frequency."""


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


def phase_weights(weights: NDArray[np.float64], frequencies: tuple[float, ...]) -> NDArray[np.float64]:
    """(frequencies,) weights of each phase, in rad of f_1, in the best estimate of f_1's; their sum is 1.

    Inverse variances for white noise: a phase of f_i has f_i / f_1 of the slope and its own number of steps.
    """
    noise = np.array([np.sum(weights[1 + 2 * i : 3 + 2 * i] ** 2) / 2.0 for i in range(len(frequencies))])
    information = (np.array(frequencies) / frequencies[0]) ** 2 / noise
    return np.asarray(information / information.sum())


@dataclass(frozen=True, eq=False)
class Groups:
    """The patterns of each frequency in groups of four rows: what the demodulating loop adds up at once.

    A frequency of three steps or more has a background of its own; one of two steps shares the first's.
    """

    frequency: NDArray[np.int64]
    """(groups,) which one."""
    patterns: NDArray[np.int64]
    """(groups, 4) indices; a group that is not full repeats its first with weight 0."""
    weights: NDArray[np.float32]
    """(groups, 3, 4): of a, C, S."""
    shared: NDArray[np.float32]
    """(frequencies, 2) weights of the first frequency's a in C and S."""


def groups(patterns: tuple[Pattern, ...], frequencies: tuple[float, ...]) -> Groups:
    """Peng and Gupta's least squares, frequency by frequency."""
    frequency, indices, weights, shared = [], [], [], np.zeros((len(frequencies), 2), np.float32)
    for i, f in enumerate(frequencies):
        own = [k for k, pattern in enumerate(patterns) if pattern.frequency == f]
        shifts = np.array([patterns[k].shift_rad for k in own])
        design = np.stack((np.ones(len(own)), np.cos(shifts), -np.sin(shifts)), axis=1)
        solution = np.zeros((3, len(own)))
        if np.linalg.matrix_rank(design, tol=1e-6) == 3:
            solution[:] = np.linalg.pinv(design)
        else:
            solution[1:] = np.linalg.pinv(design[:, 1:])
            shared[i] = -solution[1:].sum(axis=1)
        for start in range(0, len(own), 4):
            members = own[start : start + 4]
            four = np.zeros((3, 4), np.float32)
            four[:, : len(members)] = solution[:, start : start + 4]
            frequency.append(i)
            indices.append(members + members[:1] * (4 - len(members)))
            weights.append(four)
    return Groups(np.array(frequency), np.array(indices), np.stack(weights), shared)


@kernel
def _add_four(
    r0: NDArray[Any],
    r1: NDArray[Any],
    r2: NDArray[Any],
    r3: NDArray[Any],
    weights: NDArray[np.float32],
    a: NDArray[np.float32],
    c: NDArray[np.float32],
    s: NDArray[np.float32],
    brightest: NDArray[np.float32],
) -> None:
    a0, a1, a2, a3 = weights[0, 0], weights[0, 1], weights[0, 2], weights[0, 3]
    c0, c1, c2, c3 = weights[1, 0], weights[1, 1], weights[1, 2], weights[1, 3]
    s0, s1, s2, s3 = weights[2, 0], weights[2, 1], weights[2, 2], weights[2, 3]
    for x in range(a.size):
        g0, g1, g2, g3 = np.float32(r0[x]), np.float32(r1[x]), np.float32(r2[x]), np.float32(r3[x])
        a[x] += a0 * g0 + a1 * g1 + a2 * g2 + a3 * g3
        c[x] += c0 * g0 + c1 * g1 + c2 * g2 + c3 * g3
        s[x] += s0 * g0 + s1 * g1 + s2 * g2 + s3 * g3
        brightest[x] = max(max(max(g0, g1), max(g2, g3)), brightest[x])


@kernel
def _share_background(
    a: NDArray[np.float32], c_share: np.float32, s_share: np.float32, c: NDArray[np.float32], s: NDArray[np.float32]
) -> None:
    for x in range(a.size):
        c[x] = c_share * a[x]
        s[x] = s_share * a[x]


@kernel
def unwrap_row(
    components: NDArray[np.float32],
    frequencies: NDArray[np.float32],
    beat_with: NDArray[np.int64],
    beats: NDArray[np.float32],
    phase_weight: NDArray[np.float32],
    carrier: NDArray[np.float32],
    contrast_min: float,
    dark: float,
    wrapped: NDArray[np.float32],
    phase: NDArray[np.float32],
    residual: NDArray[np.float32],
    contrast: NDArray[np.float32],
) -> None:
    """Components (1 + 2 n, width) -> phase of f_1 relative to ``carrier`` (rad of f_1), NaN where not to
    be trusted.

    ``residual`` is the worst disagreement of two steps of the chain, as a share of half a period;
    ``contrast`` is b/a of f_1. ``wrapped`` is scratch (frequencies, width).
    """
    f1 = frequencies[0]
    one, nan, zero = np.float32(1.0), np.float32(np.nan), np.float32(0.0)
    least, darkest = np.float32(contrast_min), np.float32(dark)
    for i in range(frequencies.size):
        c, s, w = components[1 + 2 * i], components[2 + 2 * i], wrapped[i]
        share = frequencies[i] / f1
        for x in range(phase.size):
            w[x] = wrap(angle(s[x], c[x]) - share * carrier[x])
    residual[:] = zero
    phase[:] = zero
    fine = wrapped[0]
    known = zero
    for j in range(beats.size + 1):
        # The chain's next rung: a beat, and f_1 itself at the end; ``phase`` counts in rad of the last rung.
        last = j == beats.size
        other = wrapped[0 if last else beat_with[j]]
        rung = f1 if last else beats[j]
        gain = rung / known if j > 0 else zero
        subtract = zero if last else one
        check = zero if j == 0 else one
        for x in range(phase.size):
            value = fine[x] - subtract * other[x]
            value = wrap(value)
            coarse = gain * phase[x]
            error = (coarse - value) * PER_TURN
            order = np.floor(error + HALF)
            off = abs(error - order)
            residual[x] = max(residual[x], check * (off + off))
            phase[x] = value + check * TWO_PI * order
        known = rung
    background, c1, s1, share0 = components[0], components[1], components[2], phase_weight[0]
    for x in range(phase.size):
        b = np.sqrt(c1[x] * c1[x] + s1[x] * s1[x])
        contrast[x] = b / max(background[x], darkest)
        trusted = (contrast[x] > least) & (background[x] > darkest) & (residual[x] < np.float32(0.8))
        e = phase[x]
        fine[x] = e
        phase[x] = e * share0 if trusted else nan
    for i in range(1, frequencies.size):
        share, w, gain = frequencies[i] / f1, wrapped[i], phase_weight[i] * f1 / frequencies[i]
        for x in range(phase.size):
            expected = share * fine[x]
            phase[x] += gain * (expected + wrap(w[x] - expected))


@kernel
def _decode(
    frames: NDArray[Any],
    exposures: NDArray[np.float32],
    saturation: float,
    group_frequency: NDArray[np.int64],
    group_patterns: NDArray[np.int64],
    group_weights: NDArray[np.float32],
    shared: NDArray[np.float32],
    frequencies: NDArray[np.float32],
    beat_with: NDArray[np.int64],
    beats: NDArray[np.float32],
    phase_weight: NDArray[np.float32],
    contrast_min: float,
    dark: float,
    noise: NDArray[np.float32],
    planes: NDArray[np.float32],
    per_node: float,
    px_per_rad: float,
    z_min: float,
    z_max: float,
    fused: NDArray[np.float32],
    components: NDArray[np.float32],
    wrapped: NDArray[np.float32],
    row: NDArray[np.float32],
    scratch: NDArray[np.float32],
    points: NDArray[np.float32],
) -> int:
    """Rows in strips of ``STRIP`` columns, so that all scratch stays in the first-level cache."""
    scale, low, high = np.float32(px_per_rad), np.float32(z_min), np.float32(z_max)
    rad_per_px, one, zero, nan = np.float32(1.0) / scale, np.float32(1.0), np.float32(0.0), np.float32(np.nan)
    limit, gain, slope, offset, shortest = np.float32(saturation), noise[0], noise[1], noise[2], exposures[0]
    height, width = frames.shape[1], frames.shape[2]
    count = 0
    for v in range(height):
        for left in range(0, width, STRIP):
            n = min(STRIP, width - left)
            right = left + n
            exposed, brightest, carrier, phase = scratch[0, :n], scratch[1, :n], scratch[2, :n], scratch[3, :n]
            residual, contrast, intensity, spread = scratch[4, :n], scratch[5, :n], scratch[6, :n], scratch[7, :n]
            a, spare = components[0, :n], scratch[8, :n]
            if exposures.size > 1:
                fuse_row(frames, v, left, right, exposures, saturation, fused, exposed, brightest)
            brightest[:] = zero
            for i in range(components.shape[0]):
                components[i, :n] = zero
            for i in range(group_frequency.size):
                f = group_frequency[i]
                c, s = components[1 + 2 * f, :n], components[2 + 2 * f, :n]
                if shared[f, 0] != zero or shared[f, 1] != zero:
                    _share_background(a, shared[f, 0], shared[f, 1], c, s)
                into = a if f == 0 else spare
                k0, k1, k2, k3 = group_patterns[i]
                if exposures.size > 1:
                    _add_four(
                        fused[k0, :n], fused[k1, :n], fused[k2, :n], fused[k3, :n],
                        group_weights[i], into, c, s, brightest,
                    )  # fmt: skip
                else:
                    _add_four(
                        frames[k0, v, left:right], frames[k1, v, left:right],
                        frames[k2, v, left:right], frames[k3, v, left:right],
                        group_weights[i], into, c, s, brightest,
                    )  # fmt: skip
            triangulation.interpolate_strip(planes, v / per_node, left, right, row)
            centre = row[0, :n]
            for x in range(n):
                carrier[x] = centre[x] * rad_per_px
            unwrap_row(
                components, frequencies, beat_with, beats, phase_weight, carrier, contrast_min, dark,
                wrapped, phase, residual, contrast,
            )  # fmt: skip
            c1, s1 = components[1, :n], components[2, :n]
            if exposures.size == 1:
                for x in range(n):
                    e = phase[x]
                    phase[x] = e if brightest[x] < limit else nan
                exposed[:] = shortest
            for x in range(n):
                grey = a[x]
                power = c1[x] * c1[x] + s1[x] * s1[x]
                spread[x] = gain * (slope * grey + offset) / max(power, np.float32(1e-6))
                # Grey values at the first exposure, whatever was fused.
                intensity[x] = grey * shortest / max(exposed[x], shortest)
                residual[x] = min(contrast[x], one) * max(one - residual[x], zero)
            count += triangulation.write_row(
                row, scale, low, high, phase, intensity, residual, spread, points[v, left:right]
            )
    return count


class Conventional:
    """Collects a whole sequence, then decodes it; all memory is taken at construction.

    ``push`` every frame in order; once it says True, ``points`` decodes the sequence that has just ended.
    """

    def __init__(
        self,
        pattern_set: PatternSet,
        lookup: Lookup,
        bin_px: int,
        dtype: type[np.uint8] | type[np.uint16] = np.uint8,
        *,
        saturation_grey: float | None = None,
        dark_grey: float = 2.0,
        contrast_min: float = MODULATION_MIN,
        sensor: Sensor = IMX174,
    ) -> None:
        exposures = pattern_set.exposures_us or (1.0,)
        once = pattern_set.patterns[: len(pattern_set) // len(exposures)]
        self.frequencies = tuple(dict.fromkeys(pattern.frequency for pattern in once))
        weights = demodulation(once, self.frequencies)
        chain = unwrapping_chain(self.frequencies)
        self.frames = len(pattern_set)
        self.latency = 0
        self.lookup, self.bin_px = lookup, bin_px
        self.dark_grey, self.contrast_min = dark_grey, contrast_min
        self.saturation_grey = saturation_grey if saturation_grey else 0.98 * np.iinfo(dtype).max
        self.px_per_rad = lookup.period_px / (2.0 * math.pi * self.frequencies[0])
        self._exposures = np.array(exposures, np.float32)
        self._frequencies = np.array(self.frequencies, np.float32)
        self._beat_with = np.array([i for i, _ in chain], np.int64)
        self._beats = np.array([beat for _, beat in chain], np.float32)
        self._phase_weight = phase_weights(weights, self.frequencies).astype(np.float32)
        per_phase = np.array([np.sum(weights[1 + 2 * i : 3 + 2 * i] ** 2) / 2 for i in range(len(self.frequencies))])
        gain = np.sum((self._phase_weight * self.frequencies[0] / self._frequencies) ** 2 * per_phase)
        self._noise = np.array((gain, *sensor.variance(bin_px)), np.float32)
        self._groups = groups(once, self.frequencies)
        shape = (lookup.height, lookup.width)
        self._frames = np.zeros((self.frames, *shape), dtype if bin_px == 1 else np.float32)
        self._transposed = np.zeros(shape[::-1], np.float32)
        self._fused = np.zeros((len(once), STRIP), np.float32)
        self._components = np.zeros((weights.shape[0], STRIP), np.float32)
        self._wrapped = np.zeros((len(self.frequencies), STRIP), np.float32)
        self._row = np.zeros((triangulation.ROW_PLANES, STRIP), np.float32)
        self._scratch = np.zeros((9, STRIP), np.float32)
        self.count = 0

    def reset(self) -> None:
        """Forget the sequence so far: after a lost frame or a new epoch."""
        self.count = 0

    def restart(self) -> None:
        """A new epoch."""
        self.reset()

    def push(self, image: Image, slot: int) -> bool:
        """Take the next frame; True when it completes a sequence. A slot out of turn starts again at slot
        0."""
        if slot != self.count % self.frames:
            self.reset()
            if slot != 0:
                return False
        self.count = slot + 1
        if self.bin_px == 1:
            self._frames[slot] = image if self.lookup.axis == "columns" else image.T
        elif self.lookup.axis == "columns":
            bin_image(image, self.bin_px, self._frames[slot])
        else:
            bin_image(image, self.bin_px, self._transposed)
            self._frames[slot] = self._transposed.T
        return self.count == self.frames

    def points(self, out: NDArray[np.float32]) -> int:
        """Decode and triangulate into out, the camera grid (height, width, 6); returns the valid count."""
        lookup = self.lookup
        return _decode(
            self._frames,
            self._exposures,
            self.saturation_grey,
            self._groups.frequency,
            self._groups.patterns,
            self._groups.weights,
            self._groups.shared,
            self._frequencies,
            self._beat_with,
            self._beats,
            self._phase_weight,
            self.contrast_min,
            self.dark_grey,
            self._noise,
            lookup.planes,
            lookup.rows_per_node,
            self.px_per_rad,
            lookup.z_min_mm,
            lookup.z_max_mm,
            self._fused,
            self._components,
            self._wrapped,
            self._row,
            self._scratch,
            out if lookup.axis == "columns" else out.transpose(1, 0, 2),
        )
