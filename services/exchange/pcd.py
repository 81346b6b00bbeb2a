"""PCD 0.7, binary: the Point Cloud Library's own format. Units are not part of it; ours are mm."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d.services.exchange.finite import finite

LETTERS = {"f": "F", "i": "I", "u": "U"}


def write_pcd(points: NDArray[Any], path: str | Path) -> int:
    """Writes structured points that have a position, all their fields; returns how many."""
    rows = finite(points)
    kinds = [(name, rows.dtype[name].newbyteorder("<")) for name in rows.dtype.names or ()]
    packed = np.empty(len(rows), kinds)
    for name, _ in kinds:
        packed[name] = rows[name]
    header = {
        "VERSION": "0.7",
        "FIELDS": " ".join(name for name, _ in kinds),
        "SIZE": " ".join(str(kind.itemsize) for _, kind in kinds),
        "TYPE": " ".join(LETTERS[kind.kind] for _, kind in kinds),
        "COUNT": " ".join("1" for _ in kinds),
        "WIDTH": str(len(rows)),
        "HEIGHT": "1",
        "VIEWPOINT": "0 0 0 1 0 0 0",
        "POINTS": str(len(rows)),
        "DATA": "binary",
    }
    text = "# .PCD v0.7 - endo3d, lengths in mm\n" + "".join(f"{key} {value}\n" for key, value in header.items())
    with Path(path).open("wb") as file:
        file.write(text.encode())
        file.write(packed.tobytes())
    return len(rows)
