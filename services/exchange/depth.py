"""Depth maps as 16-bit PNG or TIFF, or as NPY in mm, with a table of their scales beside them."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from endo3d.schemas.messages import DepthMap
from endo3d.services.runtime.errors import UserError

FORMATS = ("png", "tiff", "npy")
INDEX = "depth.json"


def write_depth_maps(maps: Iterable[DepthMap], folder: str | Path, kind: str = "png") -> int:
    """Writes every map as ``<sequence>.<kind>`` and ``depth.json``; returns how many.

    png and tiff hold the 16-bit values: z_mm = offset_mm + scale_mm * value, 0 is invalid; npy holds z in mm,
    (height, width) float32, NaN is invalid. Raises ``UserError`` for another kind.
    """
    if kind not in FORMATS:
        raise UserError(f"no depth format {kind!r}; choose {', '.join(FORMATS)}")
    target = Path(folder)
    target.mkdir(parents=True, exist_ok=True)
    index = []
    for depth_map in maps:
        name = f"{depth_map.sequence:08d}.{kind}"
        write_depth_map(depth_map, target / name)
        index.append(
            {
                "file": name,
                "stamp_ns": depth_map.stamp_ns,
                "sequence": depth_map.sequence,
                "scale_mm": depth_map.scale_mm,
                "offset_mm": depth_map.offset_mm,
                "grid_px": depth_map.grid_px,
                "frame_id": depth_map.frame_id,
            }
        )
    (target / INDEX).write_text(json.dumps({"maps": index}, indent=1) + "\n")
    return len(index)


def write_depth_map(depth_map: DepthMap, path: Path) -> int:
    """Write one map as its suffix says; returns the number of valid pixels. Raises ``UserError``."""
    kind = path.suffix.lower().removeprefix(".")
    if kind not in FORMATS:
        raise UserError(f"no depth format {kind!r}; choose {', '.join(FORMATS)}")
    if kind == "npy":
        np.save(path, depth_mm(depth_map))
    elif not cv2.imwrite(str(path), depth_map.depth):
        raise UserError(f"can't write {path}; check the folder")
    return int((depth_map.depth > 0).sum())


def depth_mm(depth_map: DepthMap) -> NDArray[np.float32]:
    """(height, width) float32 z in mm, NaN where nothing was measured."""
    z_mm = np.float32(depth_map.offset_mm) + np.float32(depth_map.scale_mm) * depth_map.depth.astype(np.float32)
    return np.where(depth_map.depth > 0, z_mm, np.float32(np.nan))
