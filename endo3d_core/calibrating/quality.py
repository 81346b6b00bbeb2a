"""How good a calibration is, in the words and numbers that travel with it: its file's section ``quality``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from endo3d_core.calibrating.bundle import NAMES, Solution, parameters_of, rig_of
from endo3d_core.triangulation import exact_depth

SECTION = "quality"
REPROJECTION_MOST_PX = 0.5
COVERAGE_LEAST = 0.4
POSES_LEAST = 6
DEPTH_SIGMA_MOST = 5e-4
"""Of the depth."""


@dataclass(frozen=True, slots=True)
class Quality:
    """As it stands in the file."""

    state: str
    """``good`` or ``bad``; ``design`` when nobody calibrated."""
    reason: str = ""
    """Why it is bad."""
    poses: int = 0
    rejected: tuple[str, ...] = ()
    reprojection_px: tuple[float, float] = (0.0, 0.0)
    """Root mean square of the error's length, camera and projector."""
    depth_sigma_um: float = 0.0
    """The largest standard deviation of a depth in the volume, as far as the parameters decide it."""
    coverage: float = 0.0
    """Share of the field in which features were seen."""
    flatness_um: tuple[float, float] | None = None
    """Of the flat reference, root mean square before and after the correction."""
    gamma: float | None = None
    verified: str = ""
    """What ``verify`` found, and when."""
    sigma: Mapping[str, float] = field(default_factory=dict)
    """Standard deviation of each parameter."""

    @property
    def line(self) -> str:
        """One line for people."""
        if self.state == "design":
            return "calibration: design figures, nobody has calibrated this rig"
        seen = f"{self.poses} poses, {max(self.reprojection_px):.3f} px, depth sigma {self.depth_sigma_um:.2f} um"
        bad = f"BAD ({self.reason})" if self.state == "bad" else "good"
        return f"calibration: {bad}, {seen}" + (f", verified: {self.verified}" if self.verified else "")

    def to_yaml(self) -> str:
        """The section, to be appended to a calibration file."""
        tree = {key: _plain(value) for key, value in asdict(self).items() if value not in (None, "", {}, ())}
        return str(yaml.safe_dump({SECTION: tree}, sort_keys=False, width=1000))

    @classmethod
    def from_yaml(cls, text: str) -> Quality:
        """Of a whole calibration file; without the section its figures are a design's."""
        try:
            tree = yaml.safe_load(text) if text else None
            section = tree.get(SECTION) if isinstance(tree, Mapping) else None
            if section is None:
                return cls("design")
            flat: dict[str, Any] = dict(section)
            for key in ("rejected", "reprojection_px", "flatness_um"):
                if flat.get(key) is not None:
                    flat[key] = tuple(flat[key])
            return cls(**flat)
        except (yaml.YAMLError, TypeError, ValueError) as error:
            raise ValueError(f"the calibration's {SECTION} section is not what calibrate writes") from error


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(v) for key, v in value.items()}
    if isinstance(value, tuple):
        return [_plain(v) for v in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def depth_sigma_um(solution: Solution, pixels: NDArray[np.float64], z_mm: tuple[float, float]) -> float:
    """The largest standard deviation of depth at ``pixels`` (n, 2) between two depths, from the covariance."""
    rig = solution.rig
    sizes = (rig.camera.width, rig.camera.height), (rig.projector.width, rig.projector.height)
    start = parameters_of(rig)
    names = list(solution.sigma)
    worst = 0.0
    for z in np.linspace(*z_mm, 3):
        coordinate = rig.projector_pixel(rig.camera.ray(pixels) * z)[..., 0]
        slopes = []
        for name in names:
            moved = start.copy()
            step = max(1e-3 * solution.sigma[name], 1e-9)
            moved[NAMES.index(name)] += step
            slopes.append((exact_depth(rig_of(moved, *sizes), pixels, coordinate, float(z)) - z) / step)
        J = np.stack(slopes, axis=-1)
        variance = np.einsum("ni,ij,nj->n", J, solution.covariance, J)
        worst = max(worst, 1e3 * float(np.sqrt(np.nanmax(variance))))
    return worst


def reasons(quality: Quality, depth_mm: float) -> list[str]:
    """Why a calibration must not be used; none if it may."""
    found = []
    if quality.poses < POSES_LEAST:
        found.append(f"{quality.poses} poses are too few; take {POSES_LEAST} at least, better 15")
    if max(quality.reprojection_px) > REPROJECTION_MOST_PX:
        found.append(
            f"features are missed by {max(quality.reprojection_px):.2f} px, {REPROJECTION_MOST_PX:g} are allowed; "
            "is the board's pitch right, is it flat, did it move?"
        )
    if quality.coverage < COVERAGE_LEAST:
        found.append(
            f"features cover {quality.coverage:.0%} of the field, {COVERAGE_LEAST:.0%} are needed; "
            "move the board to the rims too"
        )
    if not quality.depth_sigma_um < 1e3 * DEPTH_SIGMA_MOST * depth_mm:
        found.append(
            f"depth is known to {quality.depth_sigma_um:.1f} um only, {1e3 * DEPTH_SIGMA_MOST * depth_mm:.1f} are "
            "allowed; tilt the board more and vary its distance"
        )
    return found
