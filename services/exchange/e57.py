"""E57 (ASTM E2807), the exchange format of 3-D scanners. It is in metres by definition."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d.services.exchange.finite import finite, xyz_mm
from endo3d.services.runtime.errors import UserError


def write_e57(points: NDArray[Any], path: str | Path) -> int:
    """Writes structured points (mm) that have a position, in metres, with intensity; returns how many.

    Raises ``UserError`` without the optional package.
    """
    try:
        import pye57
    except ModuleNotFoundError as error:
        raise UserError("E57 needs an optional package: pip install 'endo3d[e57]'") from error
    rows = finite(points)
    if not len(rows):
        raise UserError("no point to write: an E57 scan can't be empty")
    columns = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), 1e-3 * xyz_mm(rows).T, strict=True))
    if "intensity" in (rows.dtype.names or ()):
        columns["intensity"] = rows["intensity"].astype(np.float64)
    Path(path).unlink(missing_ok=True)
    file = pye57.E57(str(path), mode="w")
    file.write_scan_raw({name: np.ascontiguousarray(column) for name, column in columns.items()}, name="endo3d")
    file.close()
    return len(rows)
