"""PLY, binary little endian: every field of the points, as MeshLab, CloudCompare and trimesh read it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d.services.exchange.finite import finite

TYPES = {
    "i1": "char",
    "u1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint",
    "f4": "float",
    "f8": "double",
}


def write_ply(points: NDArray[Any], path: str | Path, *, comments: tuple[str, ...] = ()) -> int:
    """Writes structured points (any shape, x y z in mm) that have a position; returns how many.

    Fields keep their names and types.
    """
    rows = finite(points)
    names = rows.dtype.names or ()
    kinds = [(name, rows.dtype[name].newbyteorder("<")) for name in names]
    lines = ["ply", "format binary_little_endian 1.0", "comment endo3d, lengths in mm"]
    lines += [f"comment {line}" for line in comments]
    lines += [f"element vertex {len(rows)}"]
    lines += [f"property {TYPES[kind.str[1:]]} {name}" for name, kind in kinds]
    packed = np.empty(len(rows), kinds)
    for name in names:
        packed[name] = rows[name]
    with Path(path).open("wb") as file:
        file.write(("\n".join([*lines, "end_header"]) + "\n").encode())
        file.write(packed.tobytes())
    return len(rows)
