"""The merged map as a reader of its deltas sees it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d.schemas.messages import MapDelta


def starts_afresh(delta: MapDelta) -> bool:
    """Whether the map was reset, and with it the world: poses before belong to another one."""
    return delta.reset and not len(delta.points)


class MergedMap:
    """Keeps the newest point of every voxel; sorts only when asked for the points."""

    def __init__(self) -> None:
        self.merging_distance_mm = 0.0
        self._points: NDArray[Any] | None = None
        self._keys = np.empty(0, np.int64)
        self._pending: list[tuple[NDArray[Any], NDArray[np.int16]]] = []

    def add(self, delta: MapDelta) -> None:
        """Takes what changed; the arrays are copied."""
        if delta.reset:
            self._points, self._keys, self._pending = None, np.empty(0, np.int64), []
        self.merging_distance_mm = delta.merging_distance_mm
        self._pending.append((delta.points.copy(), delta.removed.reshape(-1, 3).copy()))

    def points(self) -> NDArray[Any] | None:
        """(n,) structured, the delta's own fields, one point per voxel; None before the first delta."""
        if self._pending:
            self._settle()
        return self._points

    def _settle(self) -> None:
        """Newest wins: of every key the last row stays, unless that row says the voxel is gone."""
        pending, self._pending = self._pending, []
        empty = pending[0][0][:0]
        rows, keys, alive = [self._points if self._points is not None else empty], [self._keys], [True]
        for points, removed in pending:
            rows += [np.zeros(len(removed), empty.dtype), points]
            keys += [_packed(*removed.T), _packed(points["kx"], points["ky"], points["kz"])]
            alive += [False, True]
        flags = np.repeat(alive, [len(part) for part in keys])
        every_row, every_key = np.concatenate(rows), np.concatenate(keys)
        newest = len(every_key) - 1 - np.unique(every_key[::-1], return_index=True)[1]
        newest = np.sort(newest[flags[newest]])
        self._points, self._keys = every_row[newest], every_key[newest]


def _packed(x: NDArray[Any], y: NDArray[Any], z: NDArray[Any]) -> NDArray[np.int64]:
    """One int64 per int16 voxel key."""
    wide = [np.asarray(v, np.int64) & 0xFFFF for v in (x, y, z)]
    return (wide[0] << 32) | (wide[1] << 16) | wide[2]
