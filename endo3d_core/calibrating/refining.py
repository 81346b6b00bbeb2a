"""Where the features of a board are, to a few hundredths of a pixel: the print itself is laid over the samples.

Corner finders look at gradients, and in a fibre's picture most gradients are the fibre's. Here the board as it must
look, in perspective and blurred, is compared with the samples around each feature; what is left is a shift of the
feature, by least squares with a background, a contrast, and a slope of both (Lucas and Kanade's step, 1981).
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from endo3d_core.calibrating.boards import Board
from endo3d_core.calibrating.retina import Retina

Vector = NDArray[np.float64]

TEXELS = 96
"""Of the drawn board per pitch."""
FINER = 4
"""Samples per side of a texel."""
MARGIN = 2
"""Pitches that are drawn around the outermost features."""
ITERATIONS = 3
WINDOW = 0.5
"""Radius around a feature, of the pitch: neighbours share no sample, so their errors are independent."""
SEEN_LEAST = 4
"""Features that a homography takes."""
SAMPLES_LEAST = 40
STEP_PX = 0.5
"""For derivatives."""


class Drawing:
    """A board to be looked up anywhere in its plane: 1 white, 0 black."""

    def __init__(self, board: Board, blur_mm: float) -> None:
        self._per_mm = TEXELS / board.pitch_mm
        self._low = board.points_mm.min(axis=0)[:2] - MARGIN * board.pitch_mm
        self._white = cv2.GaussianBlur(_sharp(board), (0, 0), max(blur_mm * self._per_mm, 0.3))

    def __call__(self, plane_mm: Vector) -> NDArray[np.float32]:
        """(n, 2) -> (n,)."""
        at = ((plane_mm - self._low) * self._per_mm - 0.5).astype(np.float32)
        return np.asarray(
            cv2.remap(self._white, at[:, :1], at[:, 1:], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).ravel()
        )


@lru_cache(maxsize=1)
def _sharp(board: Board) -> NDArray[np.float32]:
    """(rows, columns) texels of 0..1, the same for every pose."""
    step = board.pitch_mm / TEXELS
    low, high = board.points_mm.min(axis=0)[:2], board.points_mm.max(axis=0)[:2]
    columns, rows = np.ceil((high - low + 2 * MARGIN * board.pitch_mm) / step).astype(int)
    x, y = (
        (np.arange(n * FINER) + 0.5) * (step / FINER) + start - MARGIN * board.pitch_mm
        for n, start in ((columns, low[0]), (rows, low[1]))
    )
    dark = board.dark(x, y[:, None]).reshape(rows, FINER, columns, FINER)
    return np.asarray(1.0 - dark.mean(axis=(1, 3), dtype=np.float32))


class PlaneMap:
    """Image (px) -> board (mm): a homography, and what the lens bends as a cubic after it."""

    def __init__(self, pixels: Vector, board_mm: Vector) -> None:
        self._H, _ = cv2.findHomography(pixels, board_mm[:, :2], cv2.RANSAC, 0.2 * _pitch(board_mm))
        self._middle, self._scale = pixels.mean(axis=0), np.ptp(pixels, axis=0).max() / 2
        rest = board_mm[:, :2] - self._straight(pixels)
        terms = self._terms(pixels)
        self._bend = np.linalg.lstsq(terms, rest, rcond=None)[0] if len(pixels) > 2 * terms.shape[1] else None

    def __call__(self, pixels: Vector) -> Vector:
        """(n, 2) -> (n, 2)."""
        plane = self._straight(pixels)
        return plane if self._bend is None else plane + self._terms(pixels) @ self._bend

    def find(self, board_mm: Vector, near_px: Vector) -> Vector:
        """The inverse, (n, 2) px, by Newton's method."""
        at = near_px.copy()
        for _ in range(5):
            off = self(at) - board_mm[:, :2]
            at = at - np.linalg.solve(self.jacobian(at), off[..., None])[..., 0]
        return at

    def jacobian(self, at: Vector) -> Vector:
        """(n, 2, 2) mm per px."""
        steps = np.eye(2) * STEP_PX
        return np.stack([(self(at + step) - self(at - step)) / (2 * STEP_PX) for step in steps], axis=-1)

    def _straight(self, pixels: Vector) -> Vector:
        return np.asarray(cv2.perspectiveTransform(pixels[None], self._H)[0], np.float64)

    def _terms(self, pixels: Vector) -> Vector:
        x, y = ((pixels - self._middle) / self._scale).T
        return np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=-1)


def refine(
    board: Board, board_mm: Vector, pixels: Vector, retina: Retina, samples: NDArray[np.float32], blur_px: float
) -> Vector:
    """(n, 2) features seen about ``pixels`` -> where they are, NaN where too little is seen around one.

    ``samples`` (m,) are the retina's, evened; ``blur_px`` is the sigma of an edge in the image.
    """
    drawing: Drawing | None = None
    for _ in range(ITERATIONS):
        seen = np.all(np.isfinite(pixels), axis=1)
        if seen.sum() < SEEN_LEAST:
            return np.full_like(pixels, np.nan)
        plane = PlaneMap(pixels[seen], board_mm[seen])
        expected = plane.find(board_mm, np.where(seen[:, None], pixels, pixels[seen].mean(axis=0)))
        mm_per_px = np.sqrt(np.abs(np.linalg.det(plane.jacobian(expected))))
        drawing = drawing or Drawing(board, blur_px * float(np.median(mm_per_px)))
        pixels = np.full_like(expected, np.nan)
        for i, (at, scale) in enumerate(zip(expected, mm_per_px, strict=True)):
            radius = WINDOW * board.pitch_mm / scale
            near = np.asarray(retina.tree.query_ball_point(at, radius), np.int64)
            if near.size >= max(SAMPLES_LEAST, 0.8 * np.pi * (radius / retina.spacing_px) ** 2):
                pixels[i] = at + _shift(drawing, plane, retina.points[near], at, radius, samples[near])
    return pixels


def _shift(
    drawing: Drawing, plane: PlaneMap, points: Vector, at: Vector, radius: float, samples: NDArray[np.float32]
) -> Vector:
    """(2,) px by which the print lies beside where it was expected."""
    step_u, step_v = np.eye(2) * STEP_PX
    print_ = drawing(plane(points))
    du = (drawing(plane(points + step_u)) - drawing(plane(points - step_u))) / (2 * STEP_PX)
    dv = (drawing(plane(points + step_v)) - drawing(plane(points - step_v))) / (2 * STEP_PX)
    x, y = ((points - at) / radius).T
    A = np.stack((np.ones_like(x), x, y, print_, print_ * x, print_ * y, -du, -dv), axis=-1)
    solution = np.linalg.lstsq(A, samples.astype(np.float64), rcond=None)[0]
    contrast = solution[3]  # negative where the board was found turned by half a turn, black for white
    shift = solution[-2:] / contrast if contrast else np.full(2, np.nan)
    return shift if np.hypot(*shift) < radius / 4 else np.full(2, np.nan)


def _pitch(board_mm: Vector) -> float:
    between = np.linalg.norm(board_mm[:, None] - board_mm[None], axis=-1)
    return float(np.sort(between, axis=1)[:, 1].min())
