"""Clouds in the formats of other programs, chosen by the file's name. Lengths stay mm."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from endo3d.services.exchange.e57 import write_e57
from endo3d.services.exchange.pcd import write_pcd
from endo3d.services.exchange.ply import write_ply
from endo3d.services.exchange.xyz import write_xyz
from endo3d.services.runtime.errors import UserError

WRITERS: dict[str, Callable[[NDArray[Any], Path], int]] = {
    ".ply": write_ply,
    ".pcd": write_pcd,
    ".xyz": write_xyz,
    ".e57": write_e57,
}


def write_cloud(points: NDArray[Any], path: str | Path) -> int:
    """Writes the structured points that have a position and returns how many.

    Raises ``UserError`` for a suffix nobody knows, and where an optional package is missing.
    """
    target = Path(path)
    writer = WRITERS.get(target.suffix.lower())
    if writer is None:
        raise UserError(f"no cloud format {target.suffix or target.name!r}; choose {', '.join(WRITERS)}")
    return writer(points, target)
