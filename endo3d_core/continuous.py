"""Samples and phasors -> points, row by row: nothing between the two leaves the processor's own cache.

A row is unwrapped, fitted with its neighbours, kept where its neighbours agree, triangulated and written before the
next one is begun; what a later row needs of it stays in rings of two or three rows.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from endo3d_core import aligned, windowed_fit
from endo3d_core.binning import Grid
from endo3d_core.compiled import kernel
from endo3d_core.samples import PHASOR_UNIT, SAMPLE_UNIT, average_row
from endo3d_core.triangulation import INTENSITY, QUALITY, SIGMA, Output, Z, interpolate_row, triangulate_row, write_row
from endo3d_core.uncertainty import bandpass_variance
from endo3d_core.unwrap import NEIGHBOUR_MAX_RAD, keep_smooth_row, unwrap_row

HALF_ORDER_RAD = np.pi
"""Between neighbouring phasors: more is a step of the fringe order, not a slope."""


class Window(NamedTuple):
    """The frames around the one that is decoded."""

    phasors: NDArray[np.int16]
    """(3, height, 2, coarse width) in ``PHASOR_UNIT``."""
    samples: NDArray[np.int16]
    """(3, height, width) in ``SAMPLE_UNIT``; size 0 without the fit."""
    grids: Grid
    """(6, height, width)."""


class Places(NamedTuple):
    """Which of the window's planes: f1's phasor is the mean of two, f2's too, and the intensity of three grids."""

    first: int
    second: int
    third: int
    fourth: int
    before: int
    centre: int
    after: int


class Model(NamedTuple):
    """What never changes from frame to frame."""

    centre: NDArray[np.float32]
    """(1, nodes, width) of the lookup; without the fit the coarse width."""
    cubic: NDArray[np.float32]
    """(4, nodes, width); without the fit the coarse width."""
    rays: NDArray[np.float32]
    """(2, nodes, width)."""
    rows_per_node: float
    rad_per_px: float
    z_min_mm: float
    z_max_mm: float
    f1: float
    f2: float
    step: int
    """Columns of the output per phasor."""
    quarter_px: int
    """A quarter fringe, in columns of the output."""
    modulation_min: float
    noise_slope: float
    noise_offset: float
    """The signal's variance times background^2 is slope * background + offset."""
    outer: float
    middle: float
    """Intensity = outer (before + after) + middle centre, in grey values."""


class Scratch(NamedTuple):
    """Rows, named after what they hold."""

    coarse: NDArray[np.float32]
    """(4, coarse width)."""
    carrier: NDArray[np.float32]
    samples: NDArray[np.float32]
    bases: NDArray[np.float32]
    sums: NDArray[np.float32]
    padded: NDArray[np.float32]
    modulation: NDArray[np.float32]
    grey: NDArray[np.float32]
    phases: NDArray[np.float32]
    variances: NDArray[np.float32]
    qualities: NDArray[np.float32]
    smooth: NDArray[np.float32]
    cubic: NDArray[np.float32]
    rays: NDArray[np.float32]
    values: NDArray[np.float32]


def scratch(width: int, step: int, fit: bool) -> Scratch:
    """For outputs of this width; without the fit all but the last two are coarse."""
    coarse = width // step
    worked = width if fit else coarse

    def rows(*shape: int) -> NDArray[np.float32]:
        return aligned.zeros(shape)

    return Scratch(
        coarse=rows(4, coarse),
        carrier=rows(1, worked),
        samples=rows(2, worked),
        bases=rows(3, worked),
        sums=rows(3, 6, worked),
        padded=rows(6, worked + 2 * windowed_fit.HALF_COLUMNS),
        modulation=rows(2, worked),
        grey=rows(3, worked),
        phases=rows(3, worked),
        variances=rows(2, worked),
        qualities=rows(2, worked),
        smooth=rows(1, worked),
        cubic=rows(4, worked),
        rays=rows(2, width),
        values=rows(6, width),
    )


@kernel
def decode_fitted(window: Window, places: Places, model: Model, work: Scratch, out: Output) -> int:
    """Band-pass, windowed fit, triangulation; returns the number of valid points."""
    height = window.samples.shape[1]
    nan, count, px_per_rad = np.float32(np.nan), 0, np.float32(1.0 / model.rad_per_px)
    z_min, z_max, least = np.float32(model.z_min_mm), np.float32(model.z_max_mm), np.float32(model.modulation_min)
    slope, offset, rho = np.float32(model.noise_slope), np.float32(model.noise_offset), np.float32(model.f2 / model.f1)
    carrier, smooth, values = work.carrier[0], work.smooth[0], work.values
    coarse_carrier, start, modulation, residual = work.coarse[0], work.coarse[1], work.coarse[2], work.coarse[3]
    s1, s2 = work.samples[0], work.samples[1]
    work.sums[:] = np.float32(0.0)
    work.phases[:] = nan
    for v in range(height + 2):
        if v < height:
            interpolate_row(model.centre, v / model.rows_per_node, 0, work.carrier)
            _scale(carrier, np.float32(model.rad_per_px))
            average_row(carrier, model.step, coarse_carrier)
            _unwrap(window.phasors, places, v, coarse_carrier, model, start, modulation, residual)
            upsample(start, model.step, HALF_ORDER_RAD, smooth)
            upsample(modulation, model.step, np.inf, work.modulation[v % 2])
            windowed_fit.smooth_base(smooth, model.quarter_px, work.bases[v % 3])
            _mean_samples(window.samples[places.first, v], window.samples[places.second, v], s1)
            _mean_samples(window.samples[places.third, v], window.samples[places.fourth, v], s2)
            windowed_fit.products(work.bases[v % 3], carrier, s1, s2, rho, work.sums[v % 3])
            _mean_grey(window.grids, places, v, model, work.grey[v % 3])
        elif v == height:
            work.sums[v % 3][:] = np.float32(0.0)
        f = v - 1  # the row whose window is complete
        if 0 <= f < height:
            windowed_fit.add_rows(work.sums[0], work.sums[1], work.sums[2], work.padded)
            windowed_fit.solve(
                work.padded, work.bases[f % 3], work.modulation[f % 2], work.grey[f % 3], slope, offset, least,
                work.phases[f % 3], work.variances[f % 2], work.qualities[f % 2],
            )  # fmt: skip
        elif f == height:
            work.phases[f % 3][:] = nan
        o = v - 2  # the row whose neighbours are known
        if o >= 0:
            keep_smooth_row(
                work.phases[(o + 2) % 3], work.phases[o % 3], work.phases[(o + 1) % 3], NEIGHBOUR_MAX_RAD, smooth
            )
            interpolate_row(model.cubic, o / model.rows_per_node, 0, work.cubic)
            interpolate_row(model.rays, o / model.rows_per_node, 0, work.rays)
            triangulate_row(
                work.cubic, px_per_rad, z_min, z_max, smooth, work.variances[o % 2], values[Z], values[SIGMA]
            )
            upsample(work.grey[o % 3], 1, np.inf, values[INTENSITY])
            upsample(work.qualities[o % 2], 1, np.inf, values[QUALITY])
            count += write_row(values, work.rays, o, 0, out)
    return count


@kernel
def decode_bandpass(window: Window, places: Places, model: Model, work: Scratch, out: Output) -> int:
    """Band-pass and triangulation on every ``step``-th column, linear between them; the number of valid points."""
    height = window.phasors.shape[1]
    nan, count, px_per_rad = np.float32(np.nan), 0, np.float32(1.0 / model.rad_per_px)
    z_min, z_max = np.float32(model.z_min_mm), np.float32(model.z_max_mm)
    slope, offset = np.float32(model.noise_slope), np.float32(model.noise_offset)
    carrier, smooth, values = work.carrier[0], work.smooth[0], work.values
    z, sigma, modulation, residual = work.coarse[0], work.coarse[1], work.coarse[2], work.coarse[3]
    work.phases[:] = nan
    for v in range(height + 1):
        if v < height:
            interpolate_row(model.centre, v / model.rows_per_node, 0, work.carrier)
            _scale(carrier, np.float32(model.rad_per_px))
            _unwrap(window.phasors, places, v, carrier, model, work.phases[v % 3], modulation, residual)
            if out.points.size > 0:
                _mean_grey(window.grids, places, v, model, work.grey[v % 3])
                _grade(
                    modulation, residual, work.grey[v % 3], slope, offset, work.qualities[v % 2], work.variances[v % 2]
                )
        else:
            work.phases[v % 3][:] = nan
        o = v - 1  # the row whose neighbours are known
        if o >= 0:
            keep_smooth_row(
                work.phases[(o + 2) % 3], work.phases[o % 3], work.phases[(o + 1) % 3], NEIGHBOUR_MAX_RAD, smooth
            )
            interpolate_row(model.cubic, o / model.rows_per_node, 0, work.cubic)
            interpolate_row(model.rays, o / model.rows_per_node, 0, work.rays)
            triangulate_row(work.cubic, px_per_rad, z_min, z_max, smooth, work.variances[o % 2], z, sigma)
            upsample(z, model.step, np.inf, values[Z])
            if out.points.size > 0:
                upsample(sigma, model.step, np.inf, values[SIGMA])
                upsample(work.grey[o % 3], model.step, np.inf, values[INTENSITY])
                upsample(work.qualities[o % 2], model.step, np.inf, values[QUALITY])
            count += write_row(values, work.rays, o, 0, out)
    return count


@kernel
def _unwrap(
    phasors: NDArray[np.int16],
    places: Places,
    v: int,
    carrier: NDArray[np.float32],
    model: Model,
    phase: NDArray[np.float32],
    modulation: NDArray[np.float32],
    residual: NDArray[np.float32],
) -> None:
    unwrap_row(
        phasors[places.first, v], phasors[places.second, v], phasors[places.third, v], phasors[places.fourth, v],
        PHASOR_UNIT, carrier, model.f1, model.f2, model.modulation_min, phase, modulation, residual,
    )  # fmt: skip


@kernel
def _scale(row: NDArray[np.float32], factor: np.float32) -> None:
    for x in range(row.size):
        row[x] *= factor


@kernel
def _mean_samples(first: NDArray[np.int16], second: NDArray[np.int16], out: NDArray[np.float32]) -> None:
    """The mean of two rows; 0, for none, where either has none."""
    unit, zero = np.float32(0.5 * SAMPLE_UNIT), np.float32(0.0)
    for x in range(out.size):
        a, b = first[x], second[x]
        mean = unit * (np.float32(a) + np.float32(b))
        # Two opposite samples mean zero, not none.
        mean = mean if mean != zero else np.float32(1e-9)
        out[x] = mean if (a != 0) & (b != 0) else zero


@kernel
def _mean_grey(grids: Grid, places: Places, v: int, model: Model, out: NDArray[np.float32]) -> None:
    outer, middle = np.float32(model.outer), np.float32(model.middle)
    a, b, c = grids[places.before, v], grids[places.centre, v], grids[places.after, v]
    for x in range(out.size):
        out[x] = outer * (np.float32(a[x]) + np.float32(c[x])) + middle * np.float32(b[x])


@kernel
def _grade(
    modulation: NDArray[np.float32],
    residual: NDArray[np.float32],
    grey: NDArray[np.float32],
    slope: np.float32,
    offset: np.float32,
    quality: NDArray[np.float32],
    variance: NDArray[np.float32],
) -> None:
    """Quality 0..1 (modulation against the ideal 1/2, less the beat's disagreement) and the phase's variance."""
    one, zero = np.float32(1.0), np.float32(0.0)
    for x in range(grey.size):
        m, r, g = modulation[x], residual[x], grey[x]
        quality[x] = min(m + m, one) * max(one - r, zero)
        variance[x] = bandpass_variance(g, m, slope, offset)


@kernel
def upsample(coarse: NDArray[np.float32], step: int, jump: float, fine: NDArray[np.float32]) -> None:
    """(width / step,) cell means -> (width,), linear between the cells' centres; step is 1, 2 or 4.

    Beside an invalid cell, or one that differs by more than ``jump``, the cell's own value is held.
    """
    if step == 1:
        for x in range(coarse.size):
            fine[x] = coarse[x]
        return
    last = coarse.size - 1
    for k in range(step):
        fine[k], fine[step * last + k] = coarse[0], coarse[last]
    left, here, right, inner = coarse[: last - 1], coarse[1:last], coarse[2:], fine[step : step * last]
    most, zero = np.float32(jump), np.float32(0.0)
    if step == 2:
        quarter = np.float32(0.25)
        for x in range(here.size):
            value = here[x]
            down, up = left[x] - value, right[x] - value
            inner[2 * x] = value + quarter * (down if abs(down) < most else zero)
            inner[2 * x + 1] = value + quarter * (up if abs(up) < most else zero)
    else:
        near, far = np.float32(1.0 / 8.0), np.float32(3.0 / 8.0)
        for x in range(here.size):
            value = here[x]
            down, up = left[x] - value, right[x] - value
            down, up = down if abs(down) < most else zero, up if abs(up) < most else zero
            inner[4 * x] = value + far * down
            inner[4 * x + 1] = value + near * down
            inner[4 * x + 2] = value + near * up
            inner[4 * x + 3] = value + far * up


@kernel
def copy_rows(
    grid: Grid,
    first: int,
    row_step: int,
    average: int,
    unit: float,
    scratch: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Every ``row_step``-th row of a grid, from ``first`` on -> the same rows of out, grey means of ``average``
    columns."""
    scale = np.float32(unit)
    for v in range(first, grid.shape[0], row_step):
        row = grid[v]
        for x in range(row.size):
            scratch[x] = scale * np.float32(row[x])
        average_row(scratch, average, out[v])
