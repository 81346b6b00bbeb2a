"""A printed calibration board as the paint of a plane: black on white, as large as it says it is."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from endo3d_core.calibrating.boards import Board
from endo3d_core.virtual_rig.material import Texture

SIDE_PX = 2048
"""Of the painted tile; a power of two."""
FINER = 4
"""Samples per side of a pixel of the tile: an edge is where it is meant to a hundredth of a pixel."""
BLACK = 0.06
"""Reflectivity of the print, of the white's."""
CHARUCO_PX = 240
"""Side of a square of OpenCV's drawing."""
CIRCLE = 0.3
"""Radius of a circle, of the pitch."""
MARGIN = 1.6
"""Side of the tile over the longer side of the board: the next board lies out of sight."""


@dataclass(frozen=True)
class Print(Texture):
    """The board centred on the body's origin, its x and y along the body's."""

    kind: str = "board"
    text: str = ""
    """As ``Board.parse`` takes it."""

    @property
    def tile_mm(self) -> float:
        return MARGIN * float((np.ptp(Board.parse(self.text).points_mm, axis=0) + 2 * self._pitch_mm).max())

    @property
    def _pitch_mm(self) -> float:
        return Board.parse(self.text).pitch_mm

    def tile(self) -> NDArray[np.float32]:
        return _tile(self)


def T_body_board(board: Board) -> NDArray[np.float64]:
    """(4, 4): where the board's origin lies on the painted plane, mm."""
    T = np.eye(4)
    points = board.points_mm
    T[:3, 3] = -(points.max(axis=0) + points.min(axis=0)) / 2
    return T


@lru_cache(maxsize=2)
def _tile(paint: Print) -> NDArray[np.float32]:
    """(SIDE_PX, SIDE_PX) of BLACK..1; pixel 0 lies on the body's origin, and the tile repeats."""
    board = Board.parse(paint.text)
    step = paint.tile_mm / SIDE_PX
    middle = (np.arange(SIDE_PX) + SIDE_PX // 2) % SIDE_PX - SIDE_PX // 2
    fine = ((middle[:, None] + (np.arange(FINER) + 0.5) / FINER - 0.5) * step).ravel()
    x = fine - T_body_board(board)[0, 3]
    y = fine - T_body_board(board)[1, 3]
    out = np.empty((SIDE_PX, SIDE_PX), np.float32)
    for row in range(SIDE_PX):
        dark = _dark(board, x, y[row * FINER : (row + 1) * FINER, None])
        out[row] = 1.0 - (1.0 - BLACK) * dark.reshape(FINER, SIDE_PX, FINER).mean(axis=(0, 2))
    return out


def _dark(board: Board, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(rows, columns): where there is black, in the board's axes."""
    match board.kind:
        case "checkerboard":
            column, row = np.floor(x / board.pitch_mm), np.floor(y / board.pitch_mm)
            inside = (column >= -1) & (column < board.columns) & (row >= -1) & (row < board.rows)
            return np.asarray(inside & ((column + row) % 2 == 0))
        case "charuco":
            drawn = board.drawn(CHARUCO_PX)
            per_mm = drawn.shape[1] / (board.columns * board.pitch_mm)
            column, row = np.floor(x * per_mm).astype(int), np.floor(y * per_mm).astype(int)
            inside = (column >= 0) & (column < drawn.shape[1]) & (row >= 0) & (row < drawn.shape[0])
            at = np.clip(row, 0, drawn.shape[0] - 1), np.clip(column, 0, drawn.shape[1] - 1)
            return np.asarray(inside & (drawn[at] == 0))
        case _:
            dark = np.zeros(np.broadcast(x, y).shape, np.bool_)
            for cx, cy, _ in board.points_mm:
                if np.abs(y - cy).min() < board.pitch_mm * CIRCLE:
                    dark |= np.hypot(x - cx, y - cy) < board.pitch_mm * CIRCLE
            return dark

