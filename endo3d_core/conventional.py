"""The conventional mode: phase shifting per pixel, heterodyne unwrapping over the frequencies (section 3.1).

A pattern of frequency f and shift s is g = a + C_f cos s - S_f sin s with (C_f, S_f) = b (cos phi_f, sin
phi_f). All patterns share the background a, so two shifts are enough for the lower frequencies (Peng and
Gupta); the least-squares solution of all patterns together is the symmetric n-step formula where a
frequency has n steps.
"""

from __future__ import annotations

import math

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


@kernel
def _demodulate_row(fused: NDArray[np.float32], weights: NDArray[np.float32], out: NDArray[np.float32]) -> None:
    """fused (patterns, width) -> out (components, width); both pattern counts are multiples of four."""
    for c in range(out.shape[0]):
        row = out[c]
        row[:] = np.float32(0.0)
        for p in range(0, weights.shape[1], 4):
            w0, w1, w2, w3 = weights[c, p], weights[c, p + 1], weights[c, p + 2], weights[c, p + 3]
            if w0 == 0.0 and w1 == 0.0 and w2 == 0.0 and w3 == 0.0:
                continue
            f0, f1, f2, f3 = fused[p], fused[p + 1], fused[p + 2], fused[p + 3]
            for x in range(row.size):
                row[x] += w0 * f0[x] + w1 * f1[x] + w2 * f2[x] + w3 * f3[x]


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
        for x in range(w.size):
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
    frames: NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float32],
    exposures: NDArray[np.float32],
    saturation: float,
    weights: NDArray[np.float32],
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
    scale, low, high = np.float32(px_per_rad), np.float32(z_min), np.float32(z_max)
    rad_per_px, one, zero = np.float32(1.0) / scale, np.float32(1.0), np.float32(0.0)
    exposed, brightest, carrier, phase = scratch[0], scratch[1], scratch[2], scratch[3]
    residual, contrast, intensity, spread = scratch[4], scratch[5], scratch[6], scratch[7]
    shortest = exposures[0]
    count = 0
    for v in range(frames.shape[1]):
        fuse_row(frames, v, exposures, saturation, fused, exposed, brightest)
        _demodulate_row(fused, weights, components)
        triangulation.interpolate_row(planes, v / per_node, row)
        for x in range(carrier.size):
            carrier[x] = row[0, x] * rad_per_px
        unwrap_row(
            components, frequencies, beat_with, beats, phase_weight, carrier, contrast_min, dark,
            wrapped, phase, residual, contrast,
        )  # fmt: skip
        c1, s1, background = components[1], components[2], components[0]
        for x in range(phase.size):
            power = c1[x] * c1[x] + s1[x] * s1[x]
            variance = noise[0] * (noise[1] * background[x] + noise[2])
            spread[x] = variance / max(power, np.float32(1e-6))
            # Grey values per unit of the shortest exposure, whatever was fused.
            grey, time = background[x] * shortest, exposed[x]
            intensity[x] = grey / max(time, shortest)
            residual[x] = min(contrast[x], one) * max(one - residual[x], zero)
        count += triangulation.write_row(row, scale, low, high, phase, intensity, residual, spread, points[v])
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
        padded = 4 * -(-len(once) // 4)
        self._weights = np.zeros((weights.shape[0], padded), np.float32)
        self._weights[:, : len(once)] = weights
        shape = (lookup.height, lookup.width)
        self._frames = np.zeros((self.frames, *shape), dtype if bin_px == 1 else np.float32)
        self._transposed = np.zeros(shape[::-1], np.float32)
        self._fused = np.zeros((padded, lookup.width), np.float32)
        self._components = np.zeros((weights.shape[0], lookup.width), np.float32)
        self._wrapped = np.zeros((len(self.frequencies), lookup.width), np.float32)
        self._row = np.zeros((triangulation.ROW_PLANES, lookup.width), np.float32)
        self._scratch = np.zeros((8, lookup.width), np.float32)
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
            self._weights,
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
