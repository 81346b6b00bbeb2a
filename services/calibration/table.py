"""``capture.toml`` of a calibration folder: what its sub-folders of numbered images show.

    board = "charuco 11x9 pitch=1.1 marker=0.85"     # or checkerboard, circles, asymmetric-circles; lengths in mm
    projector = [960, 960]                           # width, height the frequencies count over, px
    boards = "board_*"                               # one folder per pose of the board
    flats = "flat_*"                                 # a plane surface, for the bow and the response; may be none
    white = "white"                                  # even light without the projector: one image or more, may be none
    head = "base6_wd20"                              # whose design figures the result takes over; may be left out

    [[pattern]]                                      # in the order of the images of a pose
    axis = "columns"
    f = 50                                           # periods over the projector, or pitch_px = 19.2
    shift = 0.0                                      # rad

The intensity of a pattern at projector pixel x of N is 1/2 + 1/2 cos(2 pi f x / N + shift).
"""

from __future__ import annotations

import math
import tomllib
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from endo3d.services.importing.capture import PatternTable
from endo3d.services.runtime.errors import UserError
from endo3d_core.calibrating.boards import Board
from endo3d_core.patterns import Axis, Pattern, PatternSet

FILE = "capture.toml"
AXES: tuple[Axis, Axis] = ("columns", "rows")


class CalibrationTable(BaseModel):
    """The whole file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    board: str
    projector: tuple[int, int]
    boards: str = "board_*"
    flats: str = "flat_*"
    white: str = "white"
    head: str = ""
    simulated: bool = False
    images: str = "*"
    """Which files of a folder; by default all that are images."""
    pattern: tuple[PatternTable, ...] = Field(min_length=6)

    @classmethod
    def read(cls, path: Path) -> CalibrationTable:
        """Raises ``UserError`` that says what is wrong in one line."""
        try:
            table = cls.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
            Board.parse(table.board)
        except OSError as error:
            raise UserError(
                f"{path}: {error.strerror}; describe the images there, see endo3d calibrate solve --help"
            ) from None
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise UserError(f"{path} is not TOML: {error}; correct that line") from None
        except ValidationError as error:
            first = error.errors()[0]
            raise UserError(f"{path}: {'.'.join(map(str, first['loc']))}: {first['msg']}") from None
        except ValueError as error:
            raise UserError(f"{path}: {error}") from None
        for axis in AXES:
            if not table.of_axis(axis)[0]:
                raise UserError(f"{path}: no pattern with axis = {axis!r}; a pose needs fringes along both axes")
        return table

    def of_axis(self, axis: Axis) -> tuple[tuple[int, ...], tuple[Pattern, ...]]:
        """Places in the list, and the patterns; both empty when there are none."""
        length_px = self.projector[0 if axis == "columns" else 1]
        chosen = [(i, p) for i, p in enumerate(self.pattern) if (p.axis or "columns") == axis]
        return (
            tuple(i for i, _ in chosen),
            tuple(
                Pattern(p.f if p.f is not None else length_px / (p.pitch_px or math.nan), p.shift, axis)
                for _, p in chosen
            ),
        ) if chosen else ((), ())


def text(
    board: Board, window: tuple[int, int], sets: tuple[PatternSet, PatternSet], head: str, simulated: bool
) -> str:
    """The file for poses of these pattern sets, columns first."""
    lines = [f'board = "{board.text}"', f"projector = [{window[0]}, {window[1]}]"]
    lines += [f'head = "{head}"'] if head else []
    lines += ["simulated = true"] if simulated else []
    for pattern_set in sets:
        for p in pattern_set.patterns:
            lines += ["", "[[pattern]]", f'axis = "{p.axis}"', f"f = {p.frequency!r}", f"shift = {p.shift_rad!r}"]
    return "\n".join([*lines, ""])
