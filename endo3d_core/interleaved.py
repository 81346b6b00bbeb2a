"""The continuous mode: one result per camera frame from the interleaved sequence (section 3.2).

Three forms keep the projected patterns and differ in how far they look:

- ``three``: the published one, eqs. (4) to (6); a is corrected to the mean, since g[k-1] + g[k+1] is twice
it.
  One frame of latency; its background leaks f1 into f2 as soon as anything moves.
- ``five``: the centre's frequency from g[k-2], g[k], g[k+2]: background and signal are symmetric in time, so
  motion enters in second order only. Two frames of latency.
- ``reuse``: every frame is normalised by its own frequency and filtered once; the neighbours' phasors are
  averaged. Second order as well, least error at hand speed, one filter per frame. Three frames of latency.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from endo3d_core import bandpass, triangulation, uncertainty, unwrap, windowed_fit
from endo3d_core.binning import Image, bin_image
from endo3d_core.compiled import kernel
from endo3d_core.patterns import PatternSet
from endo3d_core.slot_check import SlotCheck
from endo3d_core.triangulation import Lookup

Form = Literal["three", "five", "reuse"]
Planes = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]
FRAMES: dict[Form, int] = {"three": 3, "five": 5, "reuse": 7}
"""Consecutive frames that a result needs; its stamp is the middle one's."""

SIGNAL_NOISE = 0.29
"""Noise of the normalised signal per relative noise sigma_g / a of a frame: sqrt(20/256) to sqrt(24/256)."""

PERIOD = 4


@kernel
def _filter_reuse(
    before: NDArray[np.float32],
    frame: NDArray[np.float32],
    after: NDArray[np.float32],
    sign: float,
    dark: float,
    padded: NDArray[np.float32],
    cosine: NDArray[np.float32],
    sine: NDArray[np.float32],
    signal: NDArray[np.float32],
    phasor: NDArray[np.float32],
) -> None:
    """n[j] = sign (2 g[j] / (g[j-2] + 2 g[j] + g[j+2]) - 1/2) and its band-pass, row by row."""
    least, s, half, zero = np.float32(4.0 * dark), np.float32(sign), np.float32(0.5), np.float32(0.0)
    taps, width = cosine.size - 1, frame.shape[1]
    for v in range(frame.shape[0]):
        b, g, a, n = before[v], frame[v], after[v], signal[v]
        inner = padded[taps : taps + width]
        for x in range(width):
            twice = g[x] + g[x]
            total = b[x] + twice + a[x]
            value = s * (twice / total - half)
            n[x] = value if total > least else zero
            inner[x] = n[x]
        bandpass.filter_row(padded, cosine, sine, phasor[0, v], phasor[1, v])


@kernel
def _filter_difference(
    plus: NDArray[np.float32],
    minus: NDArray[np.float32],
    background: NDArray[np.float32],
    sign: float,
    dark: float,
    padded: NDArray[np.float32],
    cosine: NDArray[np.float32],
    sine: NDArray[np.float32],
    signal: NDArray[np.float32],
    phasor: NDArray[np.float32],
) -> None:
    """s = sign (plus - minus) / (2 a) and its band-pass; the background a is a mean grey value."""
    least, s, zero = np.float32(dark), np.float32(0.5 * sign), np.float32(0.0)
    taps, width = cosine.size - 1, plus.shape[1]
    for v in range(plus.shape[0]):
        p, m, a, n = plus[v], minus[v], background[v], signal[v]
        inner = padded[taps : taps + width]
        for x in range(width):
            mean = a[x]
            value = s * (p[x] - m[x]) / mean
            n[x] = value if mean > least else zero
            inner[x] = n[x]
        bandpass.filter_row(padded, cosine, sine, phasor[0, v], phasor[1, v])


@kernel
def _weighted_mean(
    a: NDArray[np.float32],
    b: NDArray[np.float32],
    c: NDArray[np.float32],
    outer: float,
    middle: float,
    out: NDArray[np.float32],
) -> None:
    """outer a + middle b + outer c: a mean grey value in which the pi pair's fringes cancel."""
    w, m = np.float32(outer), np.float32(middle)
    for v in range(out.shape[0]):
        p, q, r, row = a[v], b[v], c[v], out[v]
        for x in range(row.size):
            row[x] = w * (p[x] + r[x]) + m * q[x]


class Interleaved:
    """A window over consecutive frames, decoded after each; all memory is taken at construction.

    ``push`` every frame in order; once it says True, ``phase`` and ``points`` describe the frame
    ``latency`` back.
    """

    def __init__(
        self,
        pattern_set: PatternSet,
        lookup: Lookup,
        bin_px: int,
        *,
        form: Form = "reuse",
        fit: bool = True,
        dark_grey: float = 2.0,
        modulation_min: float = unwrap.MODULATION_MIN,
        sensor: uncertainty.Sensor = uncertainty.IMX174,
    ) -> None:
        if pattern_set.kind != "interleaved" or form not in FRAMES:
            raise ValueError(f"no {form!r} decoding of {pattern_set.text!r}")
        self.f1, self.f2 = pattern_set.frequencies
        self.lookup, self.form, self.fit, self.bin_px = lookup, form, fit, bin_px
        self.frames = FRAMES[form]
        self.latency = self.frames // 2
        self.dark_grey, self.modulation_min = dark_grey, modulation_min
        self.rad_per_px = 2.0 * math.pi * self.f1 / lookup.period_px
        self.filters = [bandpass.gabor(lookup.period_px / (f * lookup.centre_slope)) for f in (self.f1, self.f2)]
        self.count = 0
        self.slot = -1
        self._label = -1
        shape = (lookup.height, lookup.width)
        self._padded = [np.zeros(lookup.width + 2 * gabor.taps, np.float32) for gabor in self.filters]
        self._grids = np.zeros((6, *shape), np.float32)
        self.signals = np.zeros((3, *shape), np.float32)
        self.phasors = np.zeros((3, 2, *shape), np.float32)
        self._transposed = np.zeros(shape[::-1], np.float32)
        self._carrier = np.zeros(shape, np.float32)
        triangulation.carrier(lookup.planes, lookup.rows_per_node, self.rad_per_px, self._carrier)
        self._start, self._fitted, self.phase = np.zeros((3, *shape), np.float32)
        self.modulation, self.residual, self.intensity, self.quality = np.zeros((4, *shape), np.float32)
        self.variance = np.zeros(shape, np.float32)
        self._grey_variance = sensor.variance(bin_px)
        self.slots = SlotCheck(
            self.filters[0],
            max(1, round(abs(lookup.period_px / (self.f1 * lookup.centre_slope)) / 2)),
            self._carrier,
            self.f1,
            self.f2,
            lookup.reach_px * self.rad_per_px,
            dark_grey,
        )
        self._quarter_px = max(1, round(abs(lookup.period_px / (self.f1 * lookup.centre_slope)) / 4))
        self._fit_rows = np.zeros((5, lookup.width), np.float32)
        self._fit_sums = np.zeros((3, 6, lookup.width), np.float32)
        self._fit_padded = np.zeros((6, lookup.width + 2 * windowed_fit.HALF_COLUMNS), np.float32)
        self._row = np.zeros((triangulation.ROW_PLANES, lookup.width), np.float32)

    def reset(self) -> None:
        """Forget the window: after a lost frame or a slipped slot."""
        self.count = 0

    def restart(self) -> None:
        """Forget the window and what was learnt about the slots: a new epoch."""
        self.reset()
        self.slots.restart()

    def push(self, image: Image, slot: int) -> bool:
        """Take the next frame; True when a result is ready.

        A label out of turn starts a new window, and so does a slip that the images show; a negative label stands for
        the next slot.
        """
        label = slot if slot >= 0 else self._label + 1
        if self.count and label % PERIOD != (self._label + 1) % PERIOD:
            self.reset()
        self._label = label % PERIOD
        self.slot = self.slots.slot(self._label)
        self.count += 1
        if self.lookup.axis == "columns":
            bin_image(image, self.bin_px, self._grid(0))
        else:
            bin_image(image, self.bin_px, self._transposed)
            self._grid(0)[:] = self._transposed.T
        if self.count >= 3 and not self.slots.examine(self._grid(2), self._grid(1), self._grid(0), self._label):
            # The newest frame may begin a window, or be the first after its slot was put right.
            self._start_over()
            return False
        if self.form == "reuse" and self.count >= 5:
            self._filter_reuse(back=2)
        if self.count < self.frames or not self.slots.trusted:
            return False
        self._decode()
        return True

    def points(self, out: NDArray[np.float32]) -> int:
        """Triangulate the current result into out, the camera grid (height, width, 6); returns the valid
        count."""
        lookup = self.lookup
        return triangulation.write_points(
            lookup.planes,
            lookup.rows_per_node,
            1.0 / self.rad_per_px,
            lookup.z_min_mm,
            lookup.z_max_mm,
            self.phase,
            self.intensity,
            self.quality,
            self.variance,
            self._row,
            out if lookup.axis == "columns" else out.transpose(1, 0, 2),
        )

    def _start_over(self) -> None:
        """Keep the newest frame as the first of a new window, under the slot that is believed now."""
        self._grids[0] = self._grid(0)
        self.count = 1
        self.slot = self.slots.slot(self._label)

    def _grid(self, back: int) -> NDArray[np.float32]:
        """The binned frame ``back`` frames before the newest."""
        return self._grids[(self.count - 1 - back) % 6]  # type: ignore[no-any-return]

    def _place(self, back: int) -> int:
        """Where the signal and the phasor of that frame are kept."""
        return (self.count - 1 - back) % 3

    def _filter_reuse(self, back: int) -> None:
        frequency, sign = _of_slot(self.slot - back)
        gabor, place = self.filters[frequency], self._place(back)
        _filter_reuse(
            self._grid(back + 2),
            self._grid(back),
            self._grid(back - 2),
            sign,
            self.dark_grey,
            self._padded[frequency],
            gabor.cosine,
            gabor.sine,
            self.signals[place],
            self.phasors[place],
        )

    def _filter_difference(
        self, plus: NDArray[np.float32], minus: NDArray[np.float32], slot: int, scale: float, place: int
    ) -> None:
        frequency, sign = _of_slot(slot)
        gabor = self.filters[frequency]
        _filter_difference(
            plus,
            minus,
            self.intensity,
            scale * sign,
            self.dark_grey,
            self._padded[frequency],
            gabor.cosine,
            gabor.sine,
            self.signals[place],
            self.phasors[place],
        )

    def _decode(self) -> None:
        k = self.latency
        before, centre, after = self._place(k + 1), self._place(k), self._place(k - 1)
        if self.form == "three":
            _weighted_mean(self._grid(k + 1), self._grid(k), self._grid(k - 1), 0.5, 0.0, self.intensity)
        else:
            _weighted_mean(self._grid(k + 2), self._grid(k), self._grid(k - 2), 0.25, 0.5, self.intensity)
        if self.form != "reuse":
            # (g[k-1] - g[k+1]) / 4a, eq. (5), and (g[k] - a) / 2a, eq. (6) with the mean for a.
            self._filter_difference(self._grid(k + 1), self._grid(k - 1), self.slot - k - 1, 0.5, before)
            self._filter_difference(self._grid(k), self.intensity, self.slot - k, 1.0, centre)
            after = before
        unwrap.beat_unwrap(
            *self._of_both(self.phasors, before, centre, after),
            self._carrier,
            self.f1,
            self.f2,
            self.modulation_min,
            self._start,
            self.modulation,
            self.residual,
        )
        if self.fit:
            self._fit_window(before, centre, after)
        else:
            unwrap.grade(self.modulation, self.residual, self.quality)
            gain = SIGNAL_NOISE * self.filters[0].noise_gain
            uncertainty.bandpass_variance(self.intensity, self.modulation, *self._grey_variance, gain, self.variance)
        unwrap.keep_smooth(self._fitted if self.fit else self._start, unwrap.NEIGHBOUR_MAX_RAD, self.phase)

    def _of_both(self, planes: NDArray[np.float32], before: int, centre: int, after: int) -> Planes:
        """The two planes whose mean is f1's, and the two of f2's: the centre's alone, its neighbours'
        averaged."""
        alone, neighbours = (planes[centre], planes[centre]), (planes[before], planes[after])
        centre_is_f1 = _of_slot(self.slot - self.latency)[0] == 0
        return (*alone, *neighbours) if centre_is_f1 else (*neighbours, *alone)

    def _fit_window(self, before: int, centre: int, after: int) -> None:
        windowed_fit.fit(
            self._start,
            self._carrier,
            *self._of_both(self.signals, before, centre, after),
            self.f2 / self.f1,
            self._quarter_px,
            self.modulation,
            self.intensity,
            (SIGNAL_NOISE**2 * self._grey_variance[0], SIGNAL_NOISE**2 * self._grey_variance[1]),
            self.modulation_min,
            self._fit_rows,
            self._fit_sums,
            self._fit_padded,
            self._fitted,
            self.variance,
            self.quality,
        )


def _of_slot(slot: int) -> tuple[int, float]:
    """Which of the two frequencies a slot shows, and the sign that its shift of 0 or pi gives the cosine."""
    return slot % 2, 1.0 if slot % PERIOD < 2 else -1.0
