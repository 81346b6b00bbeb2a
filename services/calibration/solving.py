"""Images of a board to a rig, how well it is known, and what it must not be used for."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from endo3d.services.calibration.captured import Captured, Pose
from endo3d.services.runtime.errors import UserError
from endo3d_core import response
from endo3d_core.bow import NO_BOW
from endo3d_core.calibrating import flat_reference
from endo3d_core.calibrating.bundle import Solution
from endo3d_core.calibrating.flat_reference import Flat
from endo3d_core.calibrating.judging import depth_sigma_um, reasons
from endo3d_core.calibrating.outliers import solve_without_outliers
from endo3d_core.calibrating.quality import Quality
from endo3d_core.calibrating.retina import FibreRetina, PixelRetina, Retina
from endo3d_core.calibrating.seeing import View, covered, share_covered, sight
from endo3d_core.calibrating.sighting import Sighting
from endo3d_core.calibration import Rig
from endo3d_core.fibre import CoreMap
from endo3d_core.response import Response

FRINGES_READABLE = 0.3
"""Contrast below which a sample tells nothing of the response."""


@dataclass(frozen=True, slots=True, eq=False)
class Calibrated:
    """Everything that was found."""

    rig: Rig
    quality: Quality
    solution: Solution
    kept: list[Sighting]
    all_errors_px: dict[str, float]
    """Pose -> its error, rejected poses without one left out."""
    cells: NDArray[np.int64]
    """Coverage of the camera's field."""
    core_map: CoreMap | None
    response: Response | None
    flats: list[Flat]
    picture: NDArray[np.uint8]
    """Of the first pose that was kept."""
    seconds: float
    notes: list[str] = field(default_factory=list)

    def yaml(self, head_section: str) -> str:
        """The calibration file."""
        return self.rig.to_yaml() + self.quality.to_yaml() + head_section


def solve(source: Captured, progress: Callable[[str], None] = lambda line: None) -> Calibrated:
    """Raises ``UserError`` when nothing can be solved; a bad result says so in its quality."""
    start_s = time.monotonic()
    notes: list[str] = []
    retina, core_map = _retina(source, notes)
    rejected: dict[str, str] = {}
    sightings, picture = [], None
    for pose in source.boards:
        seen = pose.view(retina, source.window)
        try:
            sightings.append(sight(seen, source.board, retina))
        except ValueError as error:
            rejected[pose.name] = str(error)
        else:
            picture = seen.picture if picture is None else picture
        progress(pose.name)
    try:
        solved = solve_without_outliers(sightings, source.size, source.window)
    except ValueError as error:
        why = f"; left out: {_first(rejected)}" if rejected else ""
        raise UserError(f"{error}{why}") from None
    rejected |= solved.rejected
    rig = solved.solution.rig
    flats, gamma = _flats(source, retina, rig, notes, progress)
    bow = flat_reference.fit(flats)
    bent = replace(rig, bow=bow)
    cells = covered(solved.kept, retina.points if core_map else _field(retina, source))
    quality = _quality(source, solved.solution, solved.kept, rejected, cells, flats, bent, gamma)
    assert picture is not None
    return Calibrated(
        bent,
        quality,
        solved.solution,
        solved.kept,
        {s.name: solved.solution.pose_rms_px(i) for i, s in enumerate(solved.kept)},
        cells,
        core_map,
        gamma,
        flats,
        picture,
        time.monotonic() - start_s,
        notes + [f"{name} left out: {why}" for name, why in rejected.items()],
    )


def _retina(source: Captured, notes: list[str]) -> tuple[Retina, CoreMap | None]:
    """A fibre's cores where there is a fibre: in the even light, or else in the mean of the flat reference."""
    white = source.white
    if white is None and source.flats:
        white = np.mean([np.mean([i.astype(np.float32) for i in p.columns[0]()], axis=0) for p in source.flats], axis=0)
        notes.append("no image of an even light: the fibre's flat field is taken from the flat reference")
    if white is not None:
        if white.shape != source.size[::-1]:
            raise UserError(f"the even light is {white.shape[1]}x{white.shape[0]} px, the poses {source.size}")
        try:
            core_map = CoreMap.find(white)
        except ValueError as error:
            notes.append(f"no imaging fibre: {error}")
        else:
            return FibreRetina(core_map), core_map
    return PixelRetina(*source.size), None


def _field(retina: Retina, source: Captured) -> NDArray[np.float64]:
    """(n, 2) px that the camera sees lit, without a fibre: where any pose of the board is."""
    lit = np.zeros(len(retina.points), np.bool_)
    for pose in source.boards:
        lit |= pose.view(retina, source.window).lit
    return retina.points[lit]


def _flats(
    source: Captured, retina: Retina, rig: Rig, notes: list[str], progress: Callable[[str], None]
) -> tuple[list[Flat], Response | None]:
    flats, measured = [], None
    for pose in source.flats:
        seen = pose.view(retina, source.window)
        try:
            coordinate = np.where(seen.lit, seen.map_x.coordinate_px, np.nan)
            flats.append(flat_reference.measured(pose.name, rig, retina.points, coordinate))
        except ValueError as error:
            notes.append(str(error))
        measured = measured or _response(seen, notes)
        progress(pose.name)
    if not source.flats:
        notes.append("no flat reference: no correction of the bow, no response")
    return flats, measured


def _response(seen: View, notes: list[str]) -> Response | None:
    """From the steps of the frequency that has most, normalised by its own background and modulation."""
    frequencies = [p.frequency for p in seen.patterns]
    most = max(set(frequencies), key=lambda f: (frequencies.count(f), -f))
    steps = [i for i, f in enumerate(frequencies) if f == most]
    good = (seen.map_x.contrast > FRINGES_READABLE) & seen.lit
    samples = seen.fringes[steps][:, good]
    mean = samples.mean(axis=0)
    amplitude = np.sqrt(2.0 * np.mean((samples - mean) ** 2, axis=0))
    try:
        return response.measure(0.5 + 0.5 * (samples - mean) / np.maximum(amplitude, 1e-6))
    except ValueError as error:
        notes.append(f"no response: {error}")
        return None


def _quality(
    source: Captured,
    solution: Solution,
    kept: list[Sighting],
    rejected: dict[str, str],
    cells: NDArray[np.int64],
    flats: list[Flat],
    rig: Rig,
    measured: Response | None,
) -> Quality:
    pixels = np.concatenate([s.camera_px for s in kept])[:: max(1, sum(len(s.camera_px) for s in kept) // 60)]
    depths = solution.poses[:, 5]
    z_mm = float(depths.min()), float(depths.max())
    flatness = None
    if flats:
        before, after = (
            float(np.sqrt(np.mean(np.concatenate([flat_reference.flatness_um(f, bow) for f in flats]) ** 2)))
            for bow in (NO_BOW, rig.bow)
        )
        flatness = (before, after)
    quality = Quality(
        "good",
        poses=len(kept),
        rejected=tuple(rejected),
        reprojection_px=solution.rms_px,
        depth_sigma_um=depth_sigma_um(solution, pixels, z_mm),
        coverage=share_covered(cells),
        flatness_um=flatness,
        gamma=measured.gamma if measured else None,
        sigma=solution.sigma,
    )
    why = reasons(quality, float(depths.mean()))
    return replace(quality, state="bad", reason="; ".join(why)) if why else quality


def _first(rejected: dict[str, str]) -> str:
    name, why = next(iter(rejected.items()))
    return f"{name} ({why})" + (f" and {len(rejected) - 1} more" if len(rejected) > 1 else "")


def poses_of(source: Captured) -> list[Pose]:
    """All of them, for a progress bar."""
    return [*source.boards, *source.flats]
