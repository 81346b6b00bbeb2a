"""Whether a calibration may be used, and by how much its depths can be wrong."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from endo3d_core.calibrating.bundle import NAMES, Solution, parameters_of, rig_of
from endo3d_core.calibrating.quality import Quality
from endo3d_core.triangulation import exact_depth

REPROJECTION_MOST_PX = 0.5
COVERAGE_LEAST = 0.4
POSES_LEAST = 6
DEPTH_SIGMA_MOST = 5e-4
"""Of the depth."""


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
