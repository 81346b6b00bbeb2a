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
        dark = board.dark(x, y[row * FINER : (row + 1) * FINER, None])
        out[row] = 1.0 - (1.0 - BLACK) * dark.reshape(FINER, SIDE_PX, FINER).mean(axis=(0, 2))
    return out
