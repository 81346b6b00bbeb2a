"""The conventional mode: phase shifting per pixel, heterodyne unwrapping over the frequencies (section 3.1).

A sequence is decoded in one pass, in strips of rows that stay in the first-level cache: exposures are fused (``hdr``),
grey values demodulated (``demodulation``), phases unwrapped and averaged (``heterodyne``), triangulated and written.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from endo3d_core import aligned, heterodyne, triangulation
from endo3d_core.binning import Image, bin_image, grid_of
from endo3d_core.compiled import kernel
from endo3d_core.demodulation import Groups, demodulation, groups, phase_variances, phase_weights, unwrapping_chain
from endo3d_core.hdr import fuse_row
from endo3d_core.heterodyne import Chain
from endo3d_core.interleaved import SATURATION, Front
from endo3d_core.patterns import PatternSet
from endo3d_core.phase import reciprocal, root
from endo3d_core.triangulation import INTENSITY, QUALITY, SIGMA, Lookup, Output, Z
from endo3d_core.uncertainty import IMX174, Sensor

STRIP = 480
"""Columns at a time."""
MODULATION_MIN = 0.1
"""Least fringe contrast b/a of the first frequency."""


class Model(NamedTuple):
    """What never changes from sequence to sequence."""

    exposures: NDArray[np.float32]
    grey: float
    """Grey values per unit of the frames."""
    dark: float
    contrast_min: float
    noise: tuple[float, float]
    """The mean phase's variance, rad^2 of f_1, times b^2 is slope * a + offset, grey values."""
    planes: NDArray[np.float32]
    rows_per_node: float
    px_per_rad: float
    z_min_mm: float
    z_max_mm: float


class Scratch(NamedTuple):
    """Strips, named after what they hold."""

    brightest: NDArray[Any]
    fused: NDArray[Any]
    exposed: NDArray[np.float32]
    components: NDArray[np.float32]
    spare: NDArray[np.float32]
    wrapped: NDArray[np.float32]
    rows: NDArray[np.float32]
    """(5, columns): carrier, fringe phase, its mean, residual, variance."""
    lookup: NDArray[np.float32]
    values: NDArray[np.float32]


@kernel
def _add_four(
    patterns: NDArray[Any],
    fused: NDArray[Any],
    weights: NDArray[np.float32],
    kept: np.float32,
    a: NDArray[np.float32],
    c: NDArray[np.float32],
    s: NDArray[np.float32],
) -> None:
    r0, r1, r2, r3 = fused[patterns[0]], fused[patterns[1]], fused[patterns[2]], fused[patterns[3]]
    a0, a1, a2, a3 = weights[0, 0], weights[0, 1], weights[0, 2], weights[0, 3]
    c0, c1, c2, c3 = weights[1, 0], weights[1, 1], weights[1, 2], weights[1, 3]
    s0, s1, s2, s3 = weights[2, 0], weights[2, 1], weights[2, 2], weights[2, 3]
    for x in range(a.size):
        g0, g1, g2, g3 = np.float32(r0[x]), np.float32(r1[x]), np.float32(r2[x]), np.float32(r3[x])
        a[x] = kept * a[x] + a0 * g0 + a1 * g1 + a2 * g2 + a3 * g3
        c[x] = kept * c[x] + c0 * g0 + c1 * g1 + c2 * g2 + c3 * g3
        s[x] = kept * s[x] + s0 * g0 + s1 * g1 + s2 * g2 + s3 * g3


@kernel
def _add_pair(
    patterns: NDArray[Any],
    fused: NDArray[Any],
    weights: NDArray[np.float32],
    shared: NDArray[np.float32],
    kept: np.float32,
    background: NDArray[np.float32],
    c: NDArray[np.float32],
    s: NDArray[np.float32],
) -> None:
    r0, r1 = fused[patterns[0]], fused[patterns[1]]
    c0, c1, s0, s1, ca, sa = weights[1, 0], weights[1, 1], weights[2, 0], weights[2, 1], shared[0], shared[1]
    for x in range(c.size):
        g0, g1, mean = np.float32(r0[x]), np.float32(r1[x]), background[x]
        c[x] = kept * c[x] + ca * mean + c0 * g0 + c1 * g1
        s[x] = kept * s[x] + sa * mean + s0 * g0 + s1 * g1


@kernel
def _demodulate(fused: NDArray[Any], sums: Groups, components: NDArray[np.float32], spare: NDArray[np.float32]) -> None:
    """Fused patterns (patterns, columns) -> components (1 + 2 n, columns)."""
    for i in range(sums.frequency.size):
        f, kept = sums.frequency[i], np.float32(0.0 if sums.fresh[i] else 1.0)
        c, s = components[1 + 2 * f], components[2 + 2 * f]
        if sums.pair[i]:
            _add_pair(sums.patterns[i], fused, sums.weights[i], sums.shared[i], kept, components[0], c, s)
        else:
            into = components[0] if f == 0 else spare
            _add_four(sums.patterns[i], fused, sums.weights[i], kept, into, c, s)


@kernel
def _trust(
    components: NDArray[np.float32],
    residual: NDArray[np.float32],
    contrast_min: np.float32,
    dark: np.float32,
    phase: NDArray[np.float32],
) -> None:
    """NaN into phases of too little contrast or light, or whose chain disagrees."""
    a, c, s = components[0], components[1], components[2]
    limit, nan, least = np.float32(heterodyne.RESIDUAL_MAX), np.float32(np.nan), contrast_min * contrast_min
    for x in range(phase.size):
        mean, e = a[x], phase[x]
        trusted = (c[x] * c[x] + s[x] * s[x] > least * mean * mean) & (mean > dark) & (residual[x] < limit)
        phase[x] = e if trusted else nan


@kernel
def _grade(
    components: NDArray[np.float32],
    residual: NDArray[np.float32],
    exposed: NDArray[np.float32],
    model: Model,
    variance: NDArray[np.float32],
    intensity: NDArray[np.float32],
    quality: NDArray[np.float32],
) -> None:
    """Variance of the phase; intensity as the first exposure alone would show it; contrast less disagreement."""
    a, c, s = components[0], components[1], components[2]
    grey, slope, offset = np.float32(model.grey), np.float32(model.noise[0]), np.float32(model.noise[1])
    shortest, one, zero, tiny = model.exposures[0], np.float32(1.0), np.float32(0.0), np.float32(1e-6)
    for x in range(a.size):
        mean, power = grey * a[x], max(grey * grey * (c[x] * c[x] + s[x] * s[x]), tiny)
        variance[x] = (slope * mean + offset) * reciprocal(power)
        intensity[x] = mean * shortest * reciprocal(max(exposed[x], shortest))
        quality[x] = min(root(power) * reciprocal(max(mean, tiny)), one) * max(one - residual[x], zero)


@kernel
def _decode(
    frames: NDArray[Any],
    saturation: Any,
    sums: Groups,
    chain: Chain,
    model: Model,
    work: Scratch,
    out: Output,
) -> int:
    px_per_rad, rad_per_px = np.float32(model.px_per_rad), np.float32(1.0 / model.px_per_rad)
    z_min, z_max = np.float32(model.z_min_mm), np.float32(model.z_max_mm)
    contrast_min, dark = np.float32(model.contrast_min), np.float32(model.dark)
    carrier, phase, mean, residual, variance = work.rows[0], work.rows[1], work.rows[2], work.rows[3], work.rows[4]
    values, count = work.values, 0
    for v in range(frames.shape[1]):
        for left in range(0, frames.shape[2], work.exposed.size):
            fuse_row(frames, v, left, model.exposures, saturation, work.brightest, work.fused, work.exposed)
            _demodulate(work.fused, sums, work.components, work.spare)
            triangulation.interpolate_row(model.planes, v / model.rows_per_node, left, work.lookup)
            centre = work.lookup[0]
            for x in range(carrier.size):
                carrier[x] = rad_per_px * centre[x]
            heterodyne.wrap_rows(work.components, chain.frequencies, carrier, work.wrapped)
            heterodyne.unwrap_row(work.wrapped, chain, phase, residual)
            heterodyne.average_phases(work.wrapped, chain, phase, mean)
            _trust(work.components, residual, contrast_min, dark, mean)
            if out.points.size > 0:
                _grade(work.components, residual, work.exposed, model, variance, values[INTENSITY], values[QUALITY])
            triangulation.triangulate_row(
                work.lookup[1:5], px_per_rad, z_min, z_max, mean, variance, values[Z], values[SIGMA]
            )
            count += triangulation.write_row(values, work.lookup[5:7], v, left, out)
    return count


class Conventional:
    """Collects a whole sequence, then decodes it on demand; all memory is taken at construction.

    ``push`` every frame in order; once it says True, ``decode`` and ``points`` give the sequence that has just ended.
    """

    def __init__(
        self,
        pattern_set: PatternSet,
        lookup: Lookup,
        bin_px: int,
        dtype: DTypeLike = np.uint8,
        *,
        front: Front | None = None,
        saturation_grey: float | None = None,
        dark_grey: float = 2.0,
        contrast_min: float = MODULATION_MIN,
        sensor: Sensor = IMX174,
    ) -> None:
        exposures = pattern_set.exposures_us or (1.0,)
        once = pattern_set.patterns[: len(pattern_set) // len(exposures)]
        self.frequencies = tuple(dict.fromkeys(pattern.frequency for pattern in once))
        self.frames = len(pattern_set)
        self.latency = 0
        self.count = 0
        self.lookup, self.bin_px, self.front = lookup, bin_px, front
        weights = demodulation(once, self.frequencies)
        self._sums = groups(once, self.frequencies)
        self._chain = _chain(weights, self.frequencies)
        self._take_memory(dtype, len(once), len(exposures))
        saturation_grey = saturation_grey or SATURATION * np.iinfo(dtype).max
        self._saturation = self._frames.dtype.type(saturation_grey / self._grey)
        # What each phase contributes to the variance of their mean, in rad of f_1.
        shares = self._chain.weights * self.frequencies[0] / self._chain.frequencies
        gain = float(np.sum(shares**2 * phase_variances(weights)))
        slope, offset = sensor.variance(bin_px)
        self._model = Model(
            exposures=np.array(exposures, np.float32),
            grey=self._grey,
            dark=dark_grey / self._grey,
            contrast_min=contrast_min,
            noise=(gain * slope, gain * offset),
            planes=lookup.planes,
            rows_per_node=lookup.rows_per_node,
            px_per_rad=lookup.period_px / (2.0 * math.pi * self.frequencies[0]),
            z_min_mm=lookup.z_min_mm,
            z_max_mm=lookup.z_max_mm,
        )

    def _take_memory(self, dtype: DTypeLike, patterns: int, exposures: int) -> None:
        lookup = self.lookup
        kind, self._grey = (np.dtype(np.float32), 1.0) if self.front else _kept(dtype, self.bin_px)
        shape = (lookup.height, lookup.width)
        self._frames = aligned.zeros((self.frames, *shape), kind)
        self._transposed = np.zeros(shape[::-1], kind)
        columns = max(n for n in range(1, min(STRIP, lookup.width) + 1) if lookup.width % n == 0)
        wide = np.uint16 if kind.itemsize == 1 or (kind == np.uint16 and exposures == 1) else np.float32

        def rows(*shape: int) -> NDArray[np.float32]:
            return aligned.zeros(shape)

        self._scratch = Scratch(
            brightest=aligned.zeros(columns, kind),
            fused=aligned.zeros((patterns, columns), wide),
            exposed=rows(columns),
            components=rows(1 + 2 * len(self.frequencies), columns),
            spare=rows(columns),
            wrapped=rows(len(self.frequencies), columns),
            rows=rows(5, columns),
            lookup=rows(7, columns),
            values=rows(6, columns),
        )

    def reset(self) -> None:
        """Forget the sequence so far: after a lost frame or a new epoch."""
        self.count = 0

    def restart(self) -> None:
        """A new epoch."""
        self.reset()

    def push(self, image: Image, slot: int) -> bool:
        """Take the next frame; True when it completes a sequence. A slot out of turn starts again at slot 0."""
        if slot != self.count % self.frames:
            self.reset()
            if slot != 0:
                return False
        self.count = slot + 1
        target = self._frames[slot] if self.lookup.axis == "columns" else self._transposed
        if self.front is not None:
            self.front(image, target)
        elif self.bin_px == 1:
            target[:] = image
        else:
            bin_image(image, self.bin_px, self.bin_px, target)
        if self.lookup.axis == "rows":
            self._frames[slot] = self._transposed.T
        return self.count == self.frames

    def points(self, out: NDArray[np.float32]) -> int:
        """The sequence into the camera grid (height, width, 6); returns the valid count."""
        return self.decode(triangulation.output(points=out))

    def decode(self, out: Output) -> int:
        """The sequence into all that ``out`` wants, on the camera grid; returns the valid count."""

        def decode(grid: Output) -> int:
            return _decode(self._frames, self._saturation, self._sums, self._chain, self._model, self._scratch, grid)

        return triangulation.on_camera_grid(self.lookup.axis, out, decode)


def _kept(dtype: DTypeLike, bin_px: int) -> tuple[np.dtype[Any], float]:
    """What the frames are kept as, and grey values per unit: camera pixels as they are, or bins."""
    if bin_px == 1:
        return np.dtype(dtype), 1.0
    kind, grey = grid_of(dtype, bin_px, bin_px)
    return np.dtype(kind), grey


def _chain(weights: NDArray[np.float64], frequencies: tuple[float, ...]) -> Chain:
    order = unwrapping_chain(frequencies)
    return Chain(
        np.array(frequencies, np.float32),
        np.array([i for i, _ in order], np.int64),
        np.array([beat for _, beat in order], np.float32),
        phase_weights(weights, frequencies).astype(np.float32),
    )
