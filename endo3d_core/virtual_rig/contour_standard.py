"""The micro-contour standard of the paper's section 4, drawn with its calibrated dimensions (table 5)."""

from __future__ import annotations

import math

from endo3d_core.virtual_rig.profile import Contour

RADIUS_SMALL_MM = 0.4987
RADIUS_LARGE_MM = 0.9987
ANGLE_DEG = 89.96
STEP_LARGE_MM = 1.0005
STEP_SMALL_MM = 0.5004
EDGE_RADIUS_MM = 0.1

CREST_HALF_ANGLE_DEG = 65.0
"""The cylinders rise from the flat to this slope: drawn, not calibrated."""

LARGE_CYLINDER_X_MM = -7.6
SMALL_CYLINDER_X_MM = -4.7
LARGE_STEP_X_MM = -2.6
SMALL_STEP_X_MM = 0.0
WEDGE_X_MM = 4.1
ENDS_X_MM = (-11.0, 9.0)


def contour_standard() -> Contour:
    """From left to right: large cylinder, small cylinder, large step up, small step down, wedge.

    Origin on the base level; the order and the spacing are this program's, the dimensions the paper's.
    """
    crest = math.radians(CREST_HALF_ANGLE_DEG)
    top, low = STEP_LARGE_MM, STEP_LARGE_MM - STEP_SMALL_MM
    rise = 1.1
    slope = 1.0 / math.tan(math.radians(ANGLE_DEG / 2))
    r = EDGE_RADIUS_MM
    return (
        Contour(ENDS_X_MM[0], 0.0)
        .line(LARGE_CYLINDER_X_MM - RADIUS_LARGE_MM * math.sin(crest), 0.0)
        .cylinder(RADIUS_LARGE_MM, CREST_HALF_ANGLE_DEG)
        .line(SMALL_CYLINDER_X_MM - RADIUS_SMALL_MM * math.sin(crest), 0.0)
        .cylinder(RADIUS_SMALL_MM, CREST_HALF_ANGLE_DEG)
        .line(LARGE_STEP_X_MM, 0.0, r)
        .line(LARGE_STEP_X_MM, top, r)
        .line(SMALL_STEP_X_MM, top, r)
        .line(SMALL_STEP_X_MM, low, r)
        .line(WEDGE_X_MM - rise / slope, low, r)
        .line(WEDGE_X_MM, low + rise, r)
        .line(WEDGE_X_MM + (low + rise) / slope, 0.0, r)
        .line(ENDS_X_MM[1], 0.0)
    )
