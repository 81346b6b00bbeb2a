"""VDI/VDE 2634 part 2: probing errors of size and form from points on a sphere or a cylinder."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d_core import metrology

REJECTED = 0.003
"""Share of the points that the guideline lets one leave out."""
CAP = 0.87
"""Points within this share of the radius from the crest are evaluated: slopes up to 60 degrees."""
LEAST_POINTS = 100
LIMIT_UM = 100.0
"""A size error beyond this is no measurement."""

Points = NDArray[np.float64]


def form_um(distances_mm: Points) -> float:
    """Standard deviation of the distances to the fitted geometry."""
    kept = np.sort(np.abs(distances_mm - np.median(distances_mm)))
    limit = kept[int((1.0 - REJECTED) * (len(kept) - 1))]
    inside = np.abs(distances_mm - np.median(distances_mm)) <= limit
    return 1e3 * float(np.std(distances_mm[inside]))


def sphere(points: Points, centre: Points, radius_mm: float) -> dict[str, Any] | None:
    """Size, form and centre from the cap that faces the sensor; None when too little was measured.

    ``centre``: where the sphere stands, to choose the points; it does not enter the fit.
    """
    toward = centre / np.linalg.norm(centre)
    relative = points - centre
    along = relative @ toward
    across = np.linalg.norm(relative - np.outer(along, toward), axis=1)
    cap = points[(across < CAP * radius_mm) & (along < 0.0) & (along > -2.0 * radius_mm)]
    if len(cap) < LEAST_POINTS:
        return None
    fit = metrology.fit_sphere(cap)
    size_um = 1e3 * (fit.radius_mm - radius_mm)
    if abs(size_um) > LIMIT_UM:
        return None
    distances = np.linalg.norm(cap - fit.centre, axis=1) - fit.radius_mm
    return {
        "size_um": size_um,
        "form_um": form_um(distances),
        "centre": [float(value) for value in fit.centre],
        "points": len(cap),
    }


def cylinder(points: Points, x_mm: float, radius_mm: float, cap: float = CAP) -> dict[str, Any] | None:
    """Size and form of a cylinder along y whose crest is at ``x_mm``; None when too little was measured."""
    on = points[np.abs(points[:, 0] - x_mm) < cap * radius_mm]
    if len(on) < LEAST_POINTS:
        return None
    fit = metrology.fit_cylinder(on, axis=(0.0, 1.0, 0.0))
    size_um = 1e3 * (fit.radius_mm - radius_mm)
    if abs(size_um) > LIMIT_UM or not np.isfinite(size_um):
        return None
    relative = on - fit.centre
    across = relative - np.outer(relative @ fit.axis, fit.axis)
    return {
        "size_um": size_um,
        "form_um": form_um(np.linalg.norm(across, axis=1) - fit.radius_mm),
        "points": len(on),
    }
