"""The continuous mode: one result per camera frame from the interleaved sequence (section 3.2).

Three forms keep the projected patterns and differ in how far they look:

- ``three``: the published one, eqs. (4) to (6); a is corrected to the mean, since g[k-1] + g[k+1] is twice it.
  One frame of latency; its background leaks f1 into f2 as soon as anything moves.
- ``five``: the centre's frequency from g[k-2], g[k], g[k+2]: background and signal are symmetric in time, so
  motion enters in second order only. Two frames of latency.
- ``reuse``: every frame is normalised by its own frequency and filtered once; the neighbours' phasors are
  averaged. Second order as well, least error at hand speed, one filter per frame. Three frames of latency.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

from endo3d_core import aligned, bandpass, continuous, samples, triangulation, uncertainty, unwrap
from endo3d_core.binning import Grid, Image, bin_image, grid_of
from endo3d_core.patterns import PatternSet
from endo3d_core.samples import Normalisation
from endo3d_core.slot_check import ROW_STEP, SlotCheck
from endo3d_core.triangulation import Lookup, Output

Form = Literal["three", "five", "reuse"]
Front = Callable[[Image, NDArray[np.float32]], None]
"""Fills a grid (height, width) with grey values from a camera image; +inf where the sensor saturates."""
FRAMES: dict[Form, int] = {"three": 3, "five": 5, "reuse": 7}
"""Consecutive frames that a result needs; its stamp is the middle one's."""

SIGNAL_NOISE = 0.29
"""Noise of the normalised signal per relative noise sigma_g / a of a frame: sqrt(20/256) to sqrt(24/256)."""
SATURATION = 0.98
"""Of the full scale: brighter than the sensor can tell."""
SAMPLES_PER_FRINGE = 12.0
"""What the band-pass needs: on finer grids it runs on means of 2 or 4 columns."""
COLUMNS_MAX_PX = 4
"""Camera pixels that such a mean may span."""

PERIOD = 4
GRIDS = 6
"""Frames that are kept."""


class Interleaved:
    """A window over consecutive frames, decoded on demand after each; all memory is taken at construction.

    ``push`` every frame in order; once it says True, ``decode`` and ``points`` give the result of the frame
    ``latency`` back.
    """

    def __init__(
        self,
        pattern_set: PatternSet,
        lookup: Lookup,
        bin_px: int,
        dtype: DTypeLike = np.uint8,
        *,
        form: Form = "reuse",
        fit: bool = True,
        front: Front | None = None,
        dark_grey: float = 2.0,
        saturation_grey: float | None = None,
        modulation_min: float = unwrap.MODULATION_MIN,
        sensor: uncertainty.Sensor = uncertainty.IMX174,
    ) -> None:
        if pattern_set.kind != "interleaved" or form not in FRAMES:
            raise ValueError(f"no {form!r} decoding of {pattern_set.text!r}")
        self.f1, self.f2 = pattern_set.frequencies
        self.lookup, self.form, self.fit, self.bin_px, self.front = lookup, form, fit, bin_px, front
        self.frames = FRAMES[form]
        self.latency = self.frames // 2
        self.count = 0
        self.slot = -1
        self._label = -1
        fringe_px = [lookup.period_px / (f * lookup.centre_slope) for f in (self.f1, self.f2)]
        plain = front is None and lookup.axis == "columns"
        step = _columns_per_phasor(fringe_px[0], lookup.width, bin_px) if fit or plain else 1
        self.filters = [bandpass.gabor(px / step) for px in fringe_px]
        self._grid_step = 1 if fit else step
        """Columns of the output per column of the grids."""
        self._take_memory(dtype, step)
        self._dark, self._saturation = (
            grey / self._unit for grey in (dark_grey, saturation_grey or SATURATION * np.iinfo(dtype).max)
        )
        self._model = self._build_model(step, round(abs(fringe_px[0]) / 4), modulation_min, sensor)
        carrier = np.zeros((lookup.height, lookup.width // step), np.float32)
        triangulation.carrier(_coarse(lookup.planes[:1], step), lookup.rows_per_node, self._model.rad_per_px, carrier)
        self.slots = SlotCheck(
            self.filters[0],
            max(1, round(abs(fringe_px[0]) / step / 2)),
            carrier,
            self.f1,
            self.f2,
            lookup.reach_px * self._model.rad_per_px,
            dark_grey,
        )

    def _take_memory(self, dtype: DTypeLike, step: int) -> None:
        height, width = self.lookup.height, self.lookup.width
        kind, unit = grid_of(dtype, self.bin_px * self._grid_step, self.bin_px)
        kind, self._unit = (np.float32, 1.0) if self.front else (kind, unit)
        grids = aligned.zeros((GRIDS, height, width // self._grid_step), kind)
        self._window = continuous.Window(
            aligned.zeros((3, height, 2, width // step), np.int16),
            aligned.zeros((3, height, width) if self.fit else (3, 0, 0), np.int16),
            grids,
        )
        self._transposed: Grid = np.zeros((width // self._grid_step, height), kind)
        # Only the rows that the slot check looks at are ever filled, or even mapped.
        self._probes = np.zeros((3, height, width // step), np.float32)
        self._padded = [np.zeros(width // step + 2 * gabor.taps, np.float32) for gabor in self.filters]
        self._rows = aligned.zeros((3, grids.shape[2]))
        self._scratch = continuous.scratch(width, step, self.fit)

    def _build_model(
        self, step: int, quarter_px: int, modulation_min: float, sensor: uncertainty.Sensor
    ) -> continuous.Model:
        lookup, outer, middle = self.lookup, 0.25, 0.5
        if self.form == "three":
            outer, middle = 0.5, 0.0
        planes = lookup.planes[: triangulation.RAY_X]
        planes = planes if self.fit else _coarse(planes, step)
        gain = SIGNAL_NOISE if self.fit else SIGNAL_NOISE * self.filters[0].noise_gain / math.sqrt(step)
        slope, offset = sensor.variance(self.bin_px)
        return continuous.Model(
            centre=planes[:1],
            cubic=planes[1:],
            rays=lookup.planes[triangulation.RAY_X :],
            rows_per_node=lookup.rows_per_node,
            rad_per_px=2.0 * math.pi * self.f1 / lookup.period_px,
            z_min_mm=lookup.z_min_mm,
            z_max_mm=lookup.z_max_mm,
            f1=self.f1,
            f2=self.f2,
            step=step,
            quarter_px=max(1, quarter_px),
            modulation_min=modulation_min,
            noise_slope=gain**2 * slope,
            noise_offset=gain**2 * offset,
            outer=outer * self._unit,
            middle=middle * self._unit,
        )

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
        self._take(image)
        if self.count >= 3 and not self.slots.examine(self._probe(2), self._probe(1), self._probe(0), self._label):
            # The newest frame may begin a window, or be the first after its slot was put right.
            self._start_over()
            return False
        if self.form == "reuse" and self.count >= 5:
            self._normalise(2, samples.SYMMETRIC_OWN, 2, 2, (4, 2, 0))
        return self.count >= self.frames and self.slots.trusted

    def points(self, out: NDArray[np.float32]) -> int:
        """The current result into the camera grid (height, width, 6); returns the valid count."""
        return self.decode(triangulation.output(points=out))

    def decode(self, out: Output) -> int:
        """The current result into all that ``out`` wants, on the camera grid; returns the valid count."""
        k = self.latency
        if self.form == "five":
            self._normalise(k, samples.SYMMETRIC_OWN, k, k, (k + 2, k, k - 2))
            self._normalise(k + 1, samples.SYMMETRIC_PAIR, k + 1, k - 1, (k + 2, k, k - 2))
        elif self.form == "three":
            self._normalise(k, samples.PUBLISHED_OWN, k, k, (k + 1, k, k - 1))
            self._normalise(k + 1, samples.PUBLISHED_PAIR, k + 1, k - 1, (k + 1, k, k - 1))
        decode = continuous.decode_fitted if self.fit else continuous.decode_bandpass
        return triangulation.on_camera_grid(
            self.lookup.axis, out, lambda grid: decode(self._window, self._places(), self._model, self._scratch, grid)
        )

    def _places(self) -> continuous.Places:
        """The centre's frequency is seen by the centre alone, the other one by its neighbours."""
        k = self.latency
        centre, before = self._place(k), self._place(k + 1)
        after = self._place(k - 1) if self.form == "reuse" else before
        f1, f2 = ((centre, centre), (before, after))[:: 1 if _of_slot(self.slot - k)[0] == 0 else -1]
        reach = 1 if self.form == "three" else 2
        return continuous.Places(*f1, *f2, *(self._grid_index(back) for back in (k + reach, k, k - reach)))

    def _take(self, image: Image) -> None:
        """Bin the newest frame, and copy what the slot check looks at."""
        columns, rows = self.bin_px * self._grid_step, self.bin_px
        newest = self._grid(0)
        target = newest if self.lookup.axis == "columns" else self._transposed
        if self.front is not None:
            self.front(image, target)
        else:
            bin_image(image, columns, rows, target)
        if self.lookup.axis == "rows":
            newest[:] = self._transposed.T
        probe = self._probe(0)
        average = newest.shape[1] // probe.shape[1]
        continuous.copy_rows(newest, ROW_STEP // 2, ROW_STEP, average, self._unit, self._rows[0], probe)

    def _start_over(self) -> None:
        """Keep the newest frame as the first of a new window, under the slot that is believed now."""
        grids, probes = self._window.grids, self._probes
        grids[0], probes[0] = self._grid(0), self._probe(0)
        self.count = 1
        self.slot = self.slots.slot(self._label)

    def _grid_index(self, back: int) -> int:
        """Where the binned frame ``back`` frames before the newest is kept."""
        return (self.count - 1 - back) % GRIDS

    def _grid(self, back: int) -> Grid:
        return self._window.grids[self._grid_index(back)]  # type: ignore[no-any-return]

    def _place(self, back: int) -> int:
        """Where the samples, the phasors and the probe of that frame are kept."""
        return (self.count - 1 - back) % 3

    def _probe(self, back: int) -> NDArray[np.float32]:
        return self._probes[self._place(back)]  # type: ignore[no-any-return]

    def _normalise(self, back: int, form: Normalisation, plus: int, minus: int, mean: tuple[int, int, int]) -> None:
        """Samples and phasors of the frame ``back`` frames before the newest, from frames that far back."""
        frequency, sign = _of_slot(self.slot - back)
        gabor, place = self.filters[frequency], self._place(back)
        samples.normalise(
            self._grid(plus),
            self._grid(minus),
            self._grid(mean[0]),
            self._grid(mean[1]),
            self._grid(mean[2]),
            form,
            sign,
            self._dark,
            self._saturation,
            self._model.step // self._grid_step,
            gabor.cosine,
            gabor.sine,
            self._padded[frequency],
            self._rows,
            self._window.samples[place],
            self._window.phasors[place],
        )


def _of_slot(slot: int) -> tuple[int, float]:
    """Which of the two frequencies a slot shows, and the sign that its shift of 0 or pi gives the cosine."""
    return slot % 2, 1.0 if slot % PERIOD < 2 else -1.0


def _columns_per_phasor(fringe_px: float, width: int, bin_px: int) -> int:
    """As many as leave the band-pass its samples per fringe."""
    allowed = [
        step
        for step in (4, 2)
        if width % step == 0 and step * bin_px <= COLUMNS_MAX_PX and abs(fringe_px) >= step * SAMPLES_PER_FRINGE
    ]
    return allowed[0] if allowed else 1


def _coarse(planes: NDArray[np.float32], step: int) -> NDArray[np.float32]:
    """(n, nodes, width) -> (n, nodes, width / step) means."""
    means = planes.reshape(*planes.shape[:2], -1, step).mean(axis=3, dtype=np.float64)
    return np.asarray(means, np.float32)
