"""Acceptance after VDI/VDE 2634 part 2: a sphere's probing error, a plane's flatness.

Probing error P_F: the range of the distances of all points to the fitted sphere, P_S: its diameter's error against
the calibrated one. Flatness R_E: the range of the distances to the fitted plane. The guideline lets three in a
thousand of the points be left out; nothing else is filtered.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from endo3d.services.calibration.captured import Pose
from endo3d.services.runtime.errors import UserError
from endo3d_core import triangulation
from endo3d_core.calibration import Rig
from endo3d_core.conventional import Conventional
from endo3d_core.metrology import fit_plane, fit_sphere
from endo3d_core.patterns import PatternSet, sequence

LEFT_OUT = 0.003
CHANNELS = 6
BIN_PX = 2
CAP_DEG = 60.0
"""Of a sphere, about the direction to the sensor: what is steeper is not probed."""


@dataclass(frozen=True, slots=True)
class Probed:
    """One artefact at one place."""

    name: str
    count: int
    range_um: float
    """P_F or R_E."""
    size_um: float
    """P_S; 0 for a plane."""
    limit_um: float

    @property
    def passed(self) -> bool:
        return self.range_um <= self.limit_um and abs(self.size_um) <= self.limit_um

    @property
    def line(self) -> str:
        verdict = "pass" if self.passed else "FAIL"
        size = f", diameter {self.size_um:+.1f} um" if self.size_um else ""
        within = f"limit {self.limit_um:g} um, {self.count} points"
        return f"{verdict}: {self.name}: range {self.range_um:.1f} um{size}, {within}"


def points(rig: Rig, pose: Pose, z_mm: tuple[float, float]) -> NDArray[np.float64]:
    """(n, 3) mm: the pose decoded as the decoder does, along the columns."""
    images, patterns = pose.columns
    shown: PatternSet = sequence(tuple(p.frequency for p in patterns), tuple(p.shift_rad for p in patterns))
    lookup = triangulation.build(rig, BIN_PX, *z_mm)
    decoder: Conventional | None = None
    for slot, image in enumerate(images()):
        decoder = decoder or Conventional(shown, lookup, BIN_PX, image.dtype.type)
        decoder.push(image, slot)
    if decoder is None:
        raise UserError(f"{pose.name} has no images")
    out = np.empty((lookup.height, lookup.width, CHANNELS), np.float32)
    decoder.points(out)
    xyz = out[..., :3].reshape(-1, 3).astype(np.float64)
    return xyz[np.isfinite(xyz[:, 2])]


def probe(
    rig: Rig,
    poses: list[Pose],
    z_mm: tuple[float, float],
    artefact: Literal["sphere", "plane"],
    limit_um: float,
    diameter_mm: float = 0.0,
) -> Iterator[Probed]:
    """Every pose by itself. Raises ``UserError`` when one shows no such artefact."""
    for pose in poses:
        measured = points(rig, pose, z_mm)
        try:
            if artefact == "sphere":
                yield _sphere(pose.name, measured, diameter_mm, limit_um)
            else:
                yield _plane(pose.name, measured, limit_um)
        except ValueError as error:
            raise UserError(f"pose {pose.name}: {error}; is the {artefact} in the field and bright?") from None


def _plane(name: str, measured: NDArray[np.float64], limit_um: float) -> Probed:
    plane = fit_plane(measured)
    return Probed(name, len(measured), _range_um(plane.distance(measured)), 0.0, limit_um)


def _sphere(name: str, measured: NDArray[np.float64], diameter_mm: float, limit_um: float) -> Probed:
    """The cap that faces the sensor; the free fit gives the size, the fit of the calibrated size the form."""
    sphere = fit_sphere(measured)
    towards = -sphere.centre / np.linalg.norm(sphere.centre)
    on_it = np.abs(sphere.distance(measured)) < 0.2 * sphere.radius_mm
    normal = (measured - sphere.centre) / np.linalg.norm(measured - sphere.centre, axis=1, keepdims=True)
    cap = measured[on_it & (normal @ towards > np.cos(np.radians(CAP_DEG)))]
    free = fit_sphere(cap)
    held = fit_sphere(cap, diameter_mm / 2)
    return Probed(name, len(cap), _range_um(held.distance(cap)), 1e3 * (2 * free.radius_mm - diameter_mm), limit_um)


def _range_um(distance: NDArray[np.float64]) -> float:
    """Of all but three in a thousand."""
    low, high = np.quantile(distance, (LEFT_OUT / 2, 1.0 - LEFT_OUT / 2))
    return 1e3 * float(high - low)
