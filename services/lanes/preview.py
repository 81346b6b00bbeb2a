"""Reduced streams for a thin link: pictures as JPEG, every other point of a cloud, what changed in the map.

The far end makes the same kinds of messages of them, so that what reads there needs not know.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from endo3d.schemas.messages import Cloud, DepthMap, Frame, MapDelta
from endo3d.schemas.wire import Malformed


def packed_frame(frame: Frame, step: int, quality: int) -> Frame:
    """The frame with a JPEG file, (1, bytes) uint8, in the place of its image; ``step`` pixels become one."""
    image = frame.image if frame.image.dtype == np.uint8 else (frame.image >> 8).astype(np.uint8)
    if step > 1:
        height, width = image.shape
        size = max(1, width // step), max(1, height // step)
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
    _, file = cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, quality))
    return replace(frame, image=np.asarray(file, np.uint8).reshape(1, -1))


def unpacked_frame(frame: Frame) -> Frame:
    """The frame with its image again, (height, width) uint8. Raises ``Malformed``."""
    try:
        image = cv2.imdecode(np.frombuffer(frame.image.tobytes(), np.uint8), cv2.IMREAD_GRAYSCALE)
    except cv2.error as error:
        raise Malformed(f"not a JPEG picture: {error.err}") from None
    if image is None:
        raise Malformed("not a JPEG picture")
    return replace(frame, image=image.astype(np.uint8, copy=False))


def thinned_cloud(cloud: Cloud, step: int) -> Cloud:
    """Every ``step``-th row and column; the points themselves stay what was measured."""
    points = np.ascontiguousarray(cloud.points[::step, ::step])
    valid = int(np.isfinite(points["z"]).sum())
    return replace(cloud, points=points, grid_px=cloud.grid_px * step, valid_count=valid)


def thinned_depth(depth: DepthMap, step: int) -> DepthMap:
    """Every ``step``-th row and column."""
    return replace(depth, depth=np.ascontiguousarray(depth.depth[::step, ::step]), grid_px=depth.grid_px * step)


class MapChanges:
    """Changes of the map, gathered until they are sent: one delta with the same effect as all of them."""

    def __init__(self) -> None:
        self._points: list[NDArray[Any]] = []
        self._removed: list[NDArray[np.int16]] = []
        self._newest: MapDelta | None = None
        self._reset = False
        self._revision = 0

    def add(self, delta: MapDelta) -> None:
        """Takes a delta; the arrays are copied."""
        if delta.reset:
            self._points, self._removed, self._reset = [], [], True
        self._points.append(delta.points.copy())
        self._removed.append(delta.removed.reshape(-1, 3).copy())
        self._newest = replace(delta, points=self._points[-1], removed=self._removed[-1])

    def take(self) -> MapDelta | None:
        """All of it as one delta, numbered on its own; None when nothing changed."""
        newest = self._newest
        if newest is None:
            return None
        points, removed = _newest_of_each(self._points, self._removed)
        self._revision += 1
        delta = replace(newest, points=points, removed=removed, revision=self._revision, reset=self._reset)
        self._points, self._removed, self._newest, self._reset = [], [], None, False
        return delta


def _newest_of_each(
    points: list[NDArray[Any]], removed: list[NDArray[np.int16]]
) -> tuple[NDArray[Any], NDArray[np.int16]]:
    """What is left of a series of deltas, each of which removes voxels and then sets others."""
    keys = [part for pair in zip(removed, map(_keys, points), strict=True) for part in pair]
    steps = np.repeat(np.arange(len(keys)), [len(part) for part in keys])
    every_key = np.concatenate(keys)
    packed = np.ascontiguousarray(every_key).view([("x", "<i2"), ("y", "<i2"), ("z", "<i2")]).reshape(-1)
    last = len(packed) - 1 - np.unique(packed[::-1], return_index=True)[1]
    last.sort()
    set_last = last[steps[last] % 2 == 1]
    is_point = np.flatnonzero(steps % 2 == 1)
    rows = np.searchsorted(is_point, set_last)
    return np.concatenate(points)[rows], np.ascontiguousarray(every_key[last[steps[last] % 2 == 0]])


def _keys(points: NDArray[Any]) -> NDArray[np.int16]:
    """(n, 3) voxel keys of map points."""
    return np.stack([points[name] for name in ("kx", "ky", "kz")], axis=-1)
