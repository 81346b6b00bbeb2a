"""Which slot a frame really shows, from the images alone: a lost trigger leaves no other trace.

Two tests on every eighth row of the binned frames, so they cost a small share of a step:

- pair test: of a pi pair only the difference has fringes; after one, two or three lost frames the sum has them.
- four hypotheses: decode three neighbours as if the middle one showed slot 0, 1, 2, 3. Only for the right one
  does the beat predict the fringe phase and lie within the working volume; measured shares of such pixels are
  0.56..1.0 for the right slot and at most 0.17 for wrong ones.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from endo3d_core import bandpass
from endo3d_core.bandpass import Gabor
from endo3d_core.compiled import kernel
from endo3d_core.phase import HALF, PER_TURN, angle, wrap

ROW_STEP = 8
PAIR_RATIO_MAX = 0.5
"""std(sum) / std(difference) of the high-passed frames: 0.26..0.30 for a pi pair, 0.67 and more otherwise."""
PAIR_CONTRAST_MIN = 0.05
"""Below it there are no fringes to judge by."""
SCORE_MIN = 0.3
SCORE_SURE = 0.7
"""A window that decodes this well is in order, whatever moving texture does to the pair test."""
AGREEING = 2
"""Windows in a row that must agree before a slot is taken."""
CHECK_EVERY = 16
"""Frames between routine four-hypothesis checks."""
FRACTION_MAX = np.float32(0.2)


@kernel
def pair_ratio(
    first: NDArray[np.float32], second: NDArray[np.float32], half_px: int, dark: float
) -> tuple[float, float]:
    """(std(sum) / std(difference), the larger of both over the mean or 0 in the dark) of two frames (height, width).

    The difference with the pixel half a fringe on is the high-pass: it doubles fringes and removes the background.
    """
    total, apart, grey, count = 0.0, 0.0, 0.0, 0
    for v in range(ROW_STEP // 2, first.shape[0], ROW_STEP):
        width = first.shape[1] - half_px
        a, b = first[v, :width], second[v, :width]
        c, d = first[v, half_px:], second[v, half_px:]
        row_total, row_apart, row_grey = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        for x in range(width):
            p, q = a[x] - c[x], b[x] - d[x]
            row_total += (p + q) * (p + q)
            row_apart += (p - q) * (p - q)
            row_grey += a[x] + b[x]
        total += float(row_total)
        apart += float(row_apart)
        grey += float(row_grey)
        count += width
    contrast = np.sqrt(max(total, apart) * count) / grey if grey > 2.0 * dark * count else 0.0
    return np.sqrt(total / max(apart, 1e-3)), contrast


@kernel
def hypothesis_scores(
    before: NDArray[np.float32],
    centre: NDArray[np.float32],
    after: NDArray[np.float32],
    carrier_rad: NDArray[np.float32],
    f1: float,
    f2: float,
    reach_rad: float,
    dark: float,
    cosine: NDArray[np.float32],
    sine: NDArray[np.float32],
    padded: NDArray[np.float32],
    phasors: NDArray[np.float32],
    scores: NDArray[np.float64],
) -> None:
    """Share of lit pixels that decode well for each slot of the centre frame -> scores (4,).

    ``reach_rad`` is how far f1's phase leaves mid-depth within the working volume. Scratch: ``padded``
    (width + 2 taps), ``phasors`` (4, width).
    """
    taps, width = cosine.size - 1, before.shape[1]
    ratio, share, reach = np.float32(f1 / (f1 - f2)), np.float32((f1 - f2) / f1), np.float32(reach_rad)
    half, lit, inner = np.float32(0.5), 0, padded[taps : taps + width]
    pi = np.float32(np.pi)
    scores[:] = 0.0
    for v in range(ROW_STEP // 2, before.shape[0], ROW_STEP):
        b, c, a, carrier = before[v], centre[v], after[v], carrier_rad[v]
        for x in range(width):
            total = b[x] + a[x]
            value = half * (b[x] - a[x]) / total
            inner[x] = value if total > np.float32(2.0 * dark) else np.float32(0.0)
        bandpass.filter_row(padded, cosine, sine, phasors[0], phasors[1])
        for x in range(width):
            total = b[x] + a[x]
            value = (c[x] - half * total) / total
            inner[x] = value if total > np.float32(2.0 * dark) else np.float32(0.0)
        bandpass.filter_row(padded, cosine, sine, phasors[2], phasors[3])
        for x in range(width):
            n_re, n_im, c_re, c_im = phasors[0, x], phasors[1, x], phasors[2, x], phasors[3, x]
            if min(n_re * n_re + n_im * n_im, c_re * c_re + c_im * c_im) < np.float32(0.125**2):
                continue
            lit += 1
            near, mid = angle(n_im, n_re), angle(c_im, c_re)
            for slot in range(4):
                mid_phase = mid + (pi if slot >= 2 else np.float32(0.0))
                near_phase = near + (pi if (slot + 3) % 4 >= 2 else np.float32(0.0))
                phi1, phi2 = (mid_phase, near_phase) if slot % 2 == 0 else (near_phase, mid_phase)
                fine = wrap(phi1 - carrier[x])
                coarse = ratio * wrap(phi1 - phi2 - share * carrier[x])
                turns = (coarse - fine) * PER_TURN
                off = abs(turns - np.floor(turns + HALF))
                scores[slot] += 1.0 if (off < FRACTION_MAX) & (abs(coarse) < reach) else 0.0
    for slot in range(4):
        scores[slot] /= max(lit, 1)


class SlotCheck:
    """Follows the slot through lost triggers: labels in, believed slots out.

    After a slip nothing is believed until two windows in a row agree on the slot. A slip by a whole period
    is invisible and harmless.
    """

    def __init__(
        self,
        gabor: Gabor,
        half_px: int,
        carrier_rad: NDArray[np.float32],
        f1: float,
        f2: float,
        reach_rad: float,
        dark: float,
    ) -> None:
        self.slips = 0
        """Slips found and repaired."""
        self.trusted = True
        self._gabor, self._half_px, self._carrier = gabor, half_px, carrier_rad
        self._f1, self._f2, self._reach_rad, self._dark = f1, f2, reach_rad, dark
        self._padded = np.zeros(carrier_rad.shape[1] + 2 * gabor.taps, np.float32)
        self._phasors = np.zeros((4, carrier_rad.shape[1]), np.float32)
        self.scores = np.zeros(4)
        self._offset = 0
        self._candidate, self._agreed = 0, 0
        self._since = 0

    def restart(self) -> None:
        """A new epoch: labels are right again."""
        self._offset, self._agreed, self._since, self.slips, self.trusted = 0, 0, 0, 0, True

    def slot(self, label: int) -> int:
        """The slot that a label means."""
        return (label + self._offset) % 4

    def examine(
        self, before: NDArray[np.float32], centre: NDArray[np.float32], after: NDArray[np.float32], label: int
    ) -> bool:
        """Look at the three newest frames; ``label`` is the newest one's. False: the windows so far are void."""
        self._since += 1
        ratio, contrast = pair_ratio(before, after, self._half_px, self._dark)
        torn = ratio > PAIR_RATIO_MAX and contrast > PAIR_CONTRAST_MIN
        if self.trusted and not torn and self._since < CHECK_EVERY:
            return True
        self._since = 0
        best = self._best(before, centre, after)
        expected = self.slot(label - 1)
        if self.trusted:
            if self.scores[expected] >= (SCORE_SURE if torn else SCORE_MIN) or (best is None and not torn):
                return True
            self.trusted, self._agreed = False, 0
            return False
        if best is None:
            self._agreed = 0
            return True
        offset = (best - (label - 1)) % 4
        self._agreed = self._agreed + 1 if self._agreed and offset == self._candidate else 1
        self._candidate = offset
        if self._agreed < AGREEING:
            return True
        self.trusted = True
        if offset == self._offset:
            return True
        self._offset = offset
        self.slips += 1
        return False

    def _best(self, before: NDArray[np.float32], centre: NDArray[np.float32], after: NDArray[np.float32]) -> int | None:
        """The one hypothesis for the centre's slot that explains the images, if there is one."""
        hypothesis_scores(
            before, centre, after, self._carrier, self._f1, self._f2, self._reach_rad, self._dark,
            self._gabor.cosine, self._gabor.sine, self._padded, self._phasors, self.scores,
        )  # fmt: skip
        second, first = np.argsort(self.scores)[-2:]
        clear = self.scores[first] > SCORE_MIN and self.scores[first] > 2.0 * self.scores[second]
        return int(first) if clear else None
