"""``capture.toml``: what a folder of numbered images shows.

    calibration = "rig.yaml"      # camera, projector, R, t in OpenCV's terms; relative to this file
    rate_hz = 30                  # images per second
    exposure_us = 8000
    axis = "columns"              # the phase grows along the columns (or rows)
    repeat = 1                    # how often the list of patterns was shown
    z_mm = [150, 350]             # working depths; left out: half to twice where the optical axes meet

    [[pattern]]
    f = 28.8                      # periods over the projector's width (rows: height), or pitch_px = 66.67
    shift = -2.0944               # rad

Intensity at projector pixel x (0-based, of N) is 1/2 + 1/2 cos(2 pi f x / N + shift). A pattern may have an
``axis`` and an ``exposure_us`` of its own.
"""

from __future__ import annotations

import difflib
import itertools
import math
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from endo3d.services.runtime.errors import UserError
from endo3d_core import patterns
from endo3d_core.calibration import Rig
from endo3d_core.patterns import Axis, PatternSet

FILE = "capture.toml"
Z_FACTORS = (0.5, 2.0)
"""Depth range where none is given, in distances at which the optical axes come nearest."""
SAME_RAD = 1e-3
"""Shifts this close to those of a sequence of endo3d's own are taken for it."""


class PatternTable(BaseModel):
    """One ``[[pattern]]``."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    f: float | None = Field(None, gt=0)
    pitch_px: float | None = Field(None, gt=0)
    shift: float = 0.0
    axis: Axis | None = None
    exposure_us: float | None = Field(None, gt=0)

    @model_validator(mode="after")
    def _one_of_both(self) -> PatternTable:
        if (self.f is None) == (self.pitch_px is None):
            raise ValueError("a pattern needs either f (periods) or pitch_px")
        return self


class CaptureTable(BaseModel):
    """The whole file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    calibration: Path
    rate_hz: float = Field(10.0, gt=0)
    exposure_us: float = Field(10_000.0, gt=0)
    axis: Axis = "columns"
    wave: Literal["sine", "binary"] = "sine"
    gamma: float = Field(1.0, gt=0)
    repeat: int = Field(1, ge=1)
    images: str = "*"
    """Which files of the folder, e.g. ``pat0*.png``; by default all that are images."""
    z_mm: tuple[float, float] | None = None
    pattern: tuple[PatternTable, ...] = Field(min_length=1)


@dataclass(frozen=True, slots=True)
class Capture:
    """A described folder."""

    table: CaptureTable
    rig: Rig
    yaml: str
    """The calibration file, as it is."""
    sets: tuple[PatternSet, ...]
    """The patterns in order, split where the axis changes; together they are the list."""
    z_mm: tuple[float, float]

    @classmethod
    def read(cls, path: Path) -> Capture:
        """Raises ``UserError`` that says what is wrong in one line."""
        try:
            table = CaptureTable.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
        except OSError as error:
            raise UserError(f"{path}: {error.strerror}; describe the images there, see endo3d import --help") from None
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise UserError(f"{path} is not TOML: {error}; correct that line") from None
        except ValidationError as error:
            raise UserError(f"{path}: {_explained(error)}") from None
        file = path.parent / table.calibration
        try:
            yaml = file.read_text(encoding="utf-8")
            rig = Rig.from_yaml(yaml)
            sets = tuple(_sets(table, rig))
        except OSError as error:
            raise UserError(f"{file}: {error.strerror}; calibration = names the camera-projector file") from None
        except ValueError as error:
            raise UserError(f"{path}: {error}") from None
        z_mm = table.z_mm or _depths_mm(rig)
        if not 0 < z_mm[0] < z_mm[1]:
            raise UserError(f"{path}: z_mm = [{z_mm[0]:g}, {z_mm[1]:g}] is no depth range; give near and far, mm")
        return cls(table, rig, yaml, sets, z_mm)


def _sets(table: CaptureTable, rig: Rig) -> list[PatternSet]:
    """One pattern set per run of equal axis."""
    sets = []
    for axis, run in itertools.groupby(table.pattern, lambda pattern: pattern.axis or table.axis):
        length_px = rig.projector.width if axis == "columns" else rig.projector.height
        chosen = tuple(run)
        f = tuple(p.f if p.f is not None else length_px / (p.pitch_px or math.nan) for p in chosen)
        exposures = tuple(p.exposure_us or table.exposure_us for p in chosen)
        own = any(p.exposure_us is not None for p in chosen)
        shown = patterns.sequence(
            f,
            tuple(p.shift for p in chosen),
            exposures_us=exposures if own else (),
            axis=axis,
            wave=table.wave,
            gamma=table.gamma,
        )
        sets.append(_interleaved(shown) or shown)
    return sets


def _interleaved(shown: PatternSet) -> PatternSet | None:
    """The continuous mode's set, when the list is one: it then decodes frame by frame."""
    first = shown[0]
    if len(shown) != 4 or shown.exposures_us or not first.frequency > 1:
        return None
    known = patterns.interleaved(first.frequency, axis=first.axis, wave=first.wave, gamma=first.gamma)
    for ours, given in zip(known.patterns, shown.patterns, strict=True):
        off_rad = math.remainder(ours.shift_rad - given.shift_rad, math.tau)
        if not math.isclose(ours.frequency, given.frequency) or abs(off_rad) > SAME_RAD:
            return None
    return known


def _depths_mm(rig: Rig) -> tuple[float, float]:
    """About the depth where the optical axes come nearest. Raises ``UserError`` when they don't."""
    centre, axis = rig.projector_centre_mm, rig.R[2]
    forward = np.array((0.0, 0.0, 1.0))
    cosine = float(axis @ forward)
    # Nearest points of the lines s * forward and centre + r * axis.
    z_mm = float(centre @ (forward - cosine * axis)) / max(1.0 - cosine**2, 1e-12)
    if not 0 < z_mm < 1e4:
        raise UserError("the optical axes do not meet in front of the camera; give the depth range: z_mm = [near, far]")
    return Z_FACTORS[0] * z_mm, Z_FACTORS[1] * z_mm


def _explained(error: ValidationError) -> str:
    first: Any = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        model = PatternTable if first["loc"][0] == "pattern" else CaptureTable
        close = difflib.get_close_matches(str(first["loc"][-1]), model.model_fields, n=1, cutoff=0.5)
        known = f"the nearest is {close[0]!r}" if close else f"known: {', '.join(model.model_fields)}"
        return f"no key {where!r}; {known}"
    if first["type"] == "missing":
        return f"the key {where!r} is missing; add it"
    return f"{where or 'capture'}: {first['msg'].removeprefix('Value error, ')}"
