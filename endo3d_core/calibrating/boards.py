"""Calibration boards: what is printed on them, and where it is seen in an image.

A board is a short text: ``checkerboard 9x7 pitch=1.0``, ``circles 9x7 pitch=1.0``,
``asymmetric-circles 4x11 pitch=1.0`` or ``charuco 10x8 pitch=1.0 marker=0.75 dictionary=4X4_100``.
Counts are columns x rows of features (inner corners, circles), for ChArUco of squares; lengths are mm.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

Kind = Literal["checkerboard", "circles", "asymmetric-circles", "charuco"]
CIRCLE = 0.3
"""Radius of a circle, of the pitch."""
DRAWN_PX = 240
"""Side of a square in OpenCV's drawing of a ChArUco board."""
Features = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Board points (n, 3) mm with z = 0, and where they are seen (n, 2) px."""


@dataclass(frozen=True, slots=True)
class Board:
    """A printed plane."""

    kind: Kind
    columns: int
    rows: int
    pitch_mm: float
    marker_mm: float = 0.0
    dictionary: str = "4X4_100"

    @classmethod
    def parse(cls, text: str) -> Board:
        """Text -> board. Raises ``ValueError`` that says what is wrong."""
        kind, *words = text.split() or [""]
        if kind not in get_args(Kind):
            raise ValueError(f"unknown board {text!r}; it starts with one of: {', '.join(get_args(Kind))}")
        size = re.fullmatch(r"(\d+)x(\d+)", words[0]) if words else None
        if size is None:
            raise ValueError(f"board {text!r}: after {kind} comes columns x rows, like 9x7")
        keys = {"pitch"} | ({"marker", "dictionary"} if kind == "charuco" else set())
        values = dict(word.partition("=")[::2] for word in words[1:])
        if set(values) - keys or "pitch" not in values:
            raise ValueError(f"board {text!r}: it takes {', '.join(sorted(keys))}, and needs pitch=<mm>")
        try:
            pitch_mm = float(values["pitch"])
            marker_mm = float(values.get("marker", 0.75 * pitch_mm))
        except ValueError:
            raise ValueError(f"board {text!r}: pitch and marker are lengths in mm") from None
        columns, rows = int(size[1]), int(size[2])
        if columns < 3 or rows < 3 or not 0 < marker_mm < pitch_mm < np.inf:
            raise ValueError(f"board {text!r}: at least 3x3, a positive pitch, markers smaller than it")
        dictionary = values.get("dictionary", "4X4_100")
        if not hasattr(cv2.aruco, f"DICT_{dictionary}"):
            raise ValueError(f"board {text!r}: OpenCV has no marker dictionary {dictionary!r}")
        return cls(kind, columns, rows, pitch_mm, marker_mm, dictionary)  # type: ignore[arg-type]

    @property
    def text(self) -> str:
        """The canonical text; ``parse(board.text) == board``."""
        words = f"{self.kind} {self.columns}x{self.rows} pitch={self.pitch_mm:g}"
        return words + (f" marker={self.marker_mm:g} dictionary={self.dictionary}" if self.kind == "charuco" else "")

    @property
    def points_mm(self) -> NDArray[np.float64]:
        """(n, 3) all features in the order that OpenCV finds them, z = 0."""
        if self.kind == "charuco":
            return np.asarray(self._charuco().getChessboardCorners(), np.float64)
        column, row = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        if self.kind == "asymmetric-circles":
            column = 2 * column + row % 2
        points = np.stack((column.ravel(), row.ravel(), np.zeros(column.size)), axis=1)
        return np.asarray(points * self.pitch_mm, np.float64)

    def find(self, image: NDArray[np.uint8]) -> Features | None:
        """Features seen in a (height, width) uint8 image, to a fraction of a pixel; None when there are none.

        Checkerboards and circles are found whole or not at all; ChArUco corners one by one, at least six.
        """
        find = {"checkerboard": self._find_checkerboard, "charuco": self._find_charuco}.get(
            self.kind, self._find_circles
        )
        for scale in (1, 2, 4):  # grain that is finer than the board hides it from OpenCV
            size = (image.shape[1] // scale, image.shape[0] // scale)
            found = find(np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8))
            if found is not None:
                return found[0], scale * found[1] + 0.5 * (scale - 1)
        return None

    def _find_checkerboard(self, image: NDArray[np.uint8]) -> Features | None:
        flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, corners = cv2.findChessboardCornersSB(image, (self.columns, self.rows), flags=flags)
        return (self.points_mm, _refined(image, _pixels(corners), 0.4)) if found else None

    def _find_circles(self, image: NDArray[np.uint8]) -> Features | None:
        symmetric = self.kind == "circles"
        blobs = _blob_detector(image.shape)
        flags = cv2.CALIB_CB_SYMMETRIC_GRID if symmetric else cv2.CALIB_CB_ASYMMETRIC_GRID
        for shown in (image, 255 - image):  # dark circles, or bright ones
            found, centres = cv2.findCirclesGrid(
                shown, (self.columns, self.rows), flags=flags | cv2.CALIB_CB_CLUSTERING, blobDetector=blobs
            )
            if found:
                return self.points_mm, _pixels(centres)
        return None

    def _find_charuco(self, image: NDArray[np.uint8]) -> Features | None:
        corners, ids, _, _ = cv2.aruco.CharucoDetector(self._charuco()).detectBoard(image)
        if ids is None or len(ids) < 6:
            return None
        clear = (1 - self.marker_mm / self.pitch_mm) / 2  # of a square: where the nearest marker begins
        return self.points_mm[np.asarray(ids).ravel()], _refined(image, _pixels(corners), clear)

    def dark(self, x_mm: NDArray[np.float64], y_mm: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(rows, columns): where the print is black, at x (columns,) and y (rows, 1) of the board's plane."""
        match self.kind:
            case "checkerboard":
                column, row = np.floor(x_mm / self.pitch_mm), np.floor(y_mm / self.pitch_mm)
                inside = (column >= -1) & (column < self.columns) & (row >= -1) & (row < self.rows)
                return np.asarray(inside & ((column + row) % 2 == 0))
            case "charuco":
                drawn = _drawing(self)
                per_mm = DRAWN_PX / self.pitch_mm
                column, row = (np.floor(axis * per_mm).astype(np.int64) for axis in (x_mm, y_mm))
                height, width = drawn.shape
                inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
                return np.asarray(inside & (drawn[row.clip(0, height - 1), column.clip(0, width - 1)] == 0))
            case _:
                radius = CIRCLE * self.pitch_mm
                dark = np.zeros(np.broadcast(x_mm, y_mm).shape, np.bool_)
                for cx, cy, _ in self.points_mm:
                    rows, columns = np.abs(y_mm[:, 0] - cy) < radius, np.abs(x_mm - cx) < radius
                    part = np.hypot(x_mm[columns] - cx, y_mm[rows] - cy) < radius
                    dark[np.ix_(rows, columns)] |= part
                return dark

    def _charuco(self) -> Any:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary}"))
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.pitch_mm, self.marker_mm, dictionary)


def _blob_detector(shape: tuple[int, ...]) -> Any:
    """OpenCV's own takes no circle larger than 80 px across."""
    wanted = cv2.SimpleBlobDetector.Params()
    wanted.minArea, wanted.maxArea = 30.0, shape[0] * shape[1] / 50
    wanted.minDistBetweenBlobs = 5.0
    wanted.filterByConvexity, wanted.minConvexity = True, 0.8
    return cv2.SimpleBlobDetector.create(wanted)


@lru_cache(maxsize=2)
def _drawing(board: Board) -> NDArray[np.uint8]:
    size = (board.columns * DRAWN_PX, board.rows * DRAWN_PX)
    return np.asarray(board._charuco().generateImage(size), np.uint8)


def _pixels(found: Any) -> NDArray[np.float64]:
    return np.asarray(found, np.float64).reshape(-1, 2)


def _refined(image: NDArray[np.uint8], corners: NDArray[np.float64], clear: float) -> NDArray[np.float64]:
    """Saddle points to about 0.01 px; ``clear`` of a square around each is free of other edges."""
    between = np.linalg.norm(corners[:, None] - corners, axis=-1)
    spacing_px = np.sort(between, axis=1)[:, 1].min()
    window = max(2, int(clear * spacing_px) - 1)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
    return _pixels(cv2.cornerSubPix(image, corners.astype(np.float32), (window, window), (-1, -1), stop))
