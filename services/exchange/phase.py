"""The absolute phase behind a cloud, from its points and the calibration: what the projector showed them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from endo3d.schemas.messages import Cloud
from endo3d.services.runtime.errors import UserError
from endo3d_core import patterns
from endo3d_core.calibration import Rig


def absolute_phase(cloud: Cloud, rig: Rig) -> NDArray[np.float32]:
    """(height, width) float32 rad of the pattern set's first frequency, 0 at projector pixel 0; NaN is invalid.

    A cloud's points lie on the light sheets of their phases, so the phase is the points' projector coordinate;
    float32 coordinates keep it to some 1e-5 of a period.
    """
    shown = patterns.parse(cloud.pattern_set)
    axis, length_px = (0, rig.projector.width) if shown.axis == "columns" else (1, rig.projector.height)
    lit_px = rig.projector_pixel(cloud.channels[..., :3])[..., axis]
    return np.asarray(2.0 * math.pi * shown[0].frequency * lit_px / length_px, np.float32)


def write_phase(cloud: Cloud, rig: Rig, path: Path) -> int:
    """Write the phase as NPY; returns the number of valid pixels. Raises ``UserError`` for another format."""
    if path.suffix.lower() != ".npy":
        raise UserError(f"{path}: the phase is written as .npy (rad, float32); name such a file")
    phase = absolute_phase(cloud, rig)
    np.save(path, phase)
    return int(np.isfinite(phase).sum())
