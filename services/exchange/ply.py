"""PLY, binary little endian: every field of the points, as MeshLab, CloudCompare and trimesh read it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

TYPES = {
    "f4": "float",
    "f8": "double",
    "u1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint",
}


def write_ply(
    points: NDArray[Any],
    path: str | Path,
    *,
    rgb: NDArray[np.uint8] | None = None,
    comments: tuple[str, ...] = (),
) -> int:
    """Writes structured points (any shape, x y z in mm), those that have a position; returns how many.

    rgb (..., 3) adds red, green, blue. Fields keep their names and types.
    """
    flat = points.reshape(-1)
    valid = np.isfinite(flat["x"]) & np.isfinite(flat["y"]) & np.isfinite(flat["z"])
    fields = [(name, flat.dtype[name].newbyteorder("<")) for name in flat.dtype.names or ()]
    colours = [(name, np.dtype("u1")) for name in ("red", "green", "blue")] if rgb is not None else []
    rows = np.empty(int(valid.sum()), fields + colours)
    for name, _ in fields:
        rows[name] = flat[name][valid]
    if rgb is not None:
        for k, (name, _) in enumerate(colours):
            rows[name] = rgb.reshape(-1, 3)[valid, k]
    lines = ["ply", "format binary_little_endian 1.0", "comment endo3d, lengths in mm"]
    lines += [f"comment {line}" for line in comments]
    lines += [f"element vertex {len(rows)}"]
    lines += [f"property {TYPES[kind.str[1:]]} {name}" for name, kind in fields + colours]
    with Path(path).open("wb") as file:
        file.write(("\n".join([*lines, "end_header"]) + "\n").encode())
        file.write(rows.tobytes())
    return len(rows)
