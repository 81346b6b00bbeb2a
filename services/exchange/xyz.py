"""XYZ: one point per line, x y z intensity, in mm and grey values."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d.services.exchange.finite import finite, xyz_mm


def write_xyz(points: NDArray[Any], path: str | Path) -> int:
    """Writes structured points that have a position, to 0.1 um; returns how many."""
    rows = finite(points)
    columns = xyz_mm(rows)
    form = ["%.4f"] * 3
    if "intensity" in (rows.dtype.names or ()):
        columns = np.column_stack([columns, rows["intensity"]])
        form.append("%.2f")
    np.savetxt(path, columns, fmt=form)
    return len(rows)
