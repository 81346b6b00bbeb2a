"""Rows that leave a merged map, and rows that come back into one.

A finished row says all about its point (``merging``): so a map can be taken apart, its parts moved, and put together
again, and nothing is averaged twice.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d_core import voxel_hash
from endo3d_core.compiled import kernel
from endo3d_core.merging import CONFIRMED, COUNT, FIRST, GRADIENT, GREY, LAST, ROW, TEXTURE, VARIANCE, WEIGHT, MergedMap

Rows = NDArray[np.float32]
"""(n, ROW) float32, as ``merging`` lays them out; counts and sequence numbers are int32 in the same bytes."""


def finished(world: MergedMap) -> Rows:
    """A copy of all confirmed rows."""
    return world.rows[world.confirmed()]


class Retirement:
    """Takes out of a map what was not seen for long, a part per call."""

    def __init__(self, world: MergedMap, amount: int = 4096) -> None:
        self._world = world
        self._position = np.zeros(1, np.int64)
        self._out = np.empty((amount, ROW), np.float32)

    def take(self, before: int) -> Rows:
        """Evicts the next rows that were last seen before cloud ``before``; a copy of the confirmed ones."""
        world = self._world
        amount = min(len(self._out), world.used)
        count = _retire(
            before, amount, self._position, self._out, world.keys, world.index, world.rows, world.ints, world.tags,
            world.free, world.counters,
        )  # fmt: skip
        return self._out[:count].copy()


def absorb(world: MergedMap, rows: Rows) -> None:
    """Merges finished rows by their weights; those for which there is no room are counted as refused."""
    rows = np.ascontiguousarray(rows, np.float32)
    _absorb(
        rows, rows.view(np.int32), world.merging_distance_mm, world.keys, world.index, world.rows, world.ints,
        world.tags, world.moved, world.free, world.dirty, world.counters,
    )  # fmt: skip


@kernel
def _retire(
    before: Any, amount: Any, position: Any, out: Any, keys: Any, index: Any, rows: Any, ints: Any, tags: Any,
    free: Any, counters: Any,
) -> Any:  # fmt: skip
    count = 0
    for _ in range(amount):
        row = position[0]
        position[0] = row + 1 if row + 1 < counters[0] else 0
        if ints[row, COUNT] == 0 or ints[row, LAST] >= before:
            continue
        if ints[row, COUNT] >= CONFIRMED:
            out[count] = rows[row]
            count += 1
        voxel_hash.remove(
            keys, index, voxel_hash.pack(np.int64(tags[row, 0]), np.int64(tags[row, 1]), np.int64(tags[row, 2]))
        )
        ints[row, COUNT] = 0
        free[counters[1]] = row
        counters[1] += 1
    return count


@kernel
def _behind(keys: Any, index: Any, rows: Any, kx: Any, ky: Any, kz: Any, p: Any, d: Any) -> Any:
    """The row of a neighbouring voxel whose point lies within ``d`` of ``p`` along its own normal, and near; or -1.

    The same rule as merging's, for points that no longer know from where they were seen: noise along the normal
    splits no surface.
    """
    axis = 2
    if abs(p[3]) > abs(p[4]) and abs(p[3]) > abs(p[5]):
        axis = 0
    elif abs(p[4]) > abs(p[5]):
        axis = 1
    best: Any = np.int64(-1)
    best_gap = np.float32(d)
    for step in (-1, 1):
        key = voxel_hash.pack(
            kx + (step if axis == 0 else 0), ky + (step if axis == 1 else 0), kz + (step if axis == 2 else 0)
        )
        row = voxel_hash.find(keys, index, key)
        if row >= 0:
            gap = abs(rows[row, axis] - p[axis])
            if gap < best_gap:
                best, best_gap = row, gap
    return best


@kernel
def _absorb(
    given: Any, given_ints: Any, d: Any, keys: Any, index: Any, rows: Any, ints: Any, tags: Any, moved: Any, free: Any,
    dirty: Any, counters: Any,
) -> None:  # fmt: skip
    per_voxel, zero, one = np.float32(1.0 / d), np.float32(0.0), np.float32(1.0)
    offset, two_offsets = np.float32(32768.0), np.float32(65534.0)
    for i in range(given.shape[0]):
        p = given[i]
        fx, fy, fz = p[0] * per_voxel + offset, p[1] * per_voxel + offset, p[2] * per_voxel + offset
        if not (one < min(fx, min(fy, fz)) and max(fx, max(fy, fz)) < two_offsets):
            counters[6] += 1
            continue
        kx, ky, kz = np.int64(fx) - 32768, np.int64(fy) - 32768, np.int64(fz) - 32768
        key = voxel_hash.pack(kx, ky, kz)
        row: Any = voxel_hash.find(keys, index, key)
        if row < 0:
            row = _behind(keys, index, rows, kx, ky, kz, p, d)
        if row < 0:
            if counters[1] > 0:
                counters[1] -= 1
                row = np.int64(free[counters[1]])
            elif counters[0] < rows.shape[0]:
                row = counters[0]
                counters[0] += 1
            else:
                counters[6] += 1
                continue
            voxel_hash.insert(keys, index, key, row)
            rows[row] = p
            moved[row] = zero
            tags[row, 0], tags[row, 1], tags[row, 2], tags[row, 3] = kx, ky, kz, 0
        else:
            q = rows[row]
            total = q[WEIGHT] + p[WEIGHT]
            share = p[WEIGHT] / total
            nx, ny, nz = (
                q[3] + share * (p[3] - q[3]),
                q[4] + share * (p[4] - q[4]),
                q[5] + share * (p[5] - q[5]),
            )
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            if length > zero:
                nx, ny, nz = nx / length, ny / length, nz / length
            dx, dy, dz = p[0] - q[0], p[1] - q[1], p[2] - q[2]
            off = nx * dx + ny * dy + nz * dz
            # Of two groups: the mean of their variances, and that of their means.
            q[VARIANCE] += share * (p[VARIANCE] - q[VARIANCE]) + share * (one - share) * off * off
            moved[row] += share * off
            q[0], q[1], q[2] = q[0] + share * dx, q[1] + share * dy, q[2] + share * dz
            q[3], q[4], q[5] = nx, ny, nz
            q[GREY] += share * (p[GREY] - q[GREY])
            q[TEXTURE] += share * (p[TEXTURE] - q[TEXTURE])
            for k in range(GRADIENT, GRADIENT + 3):
                q[k] += share * (p[k] - q[k])
            q[WEIGHT] = total
            ints[row, COUNT] += given_ints[i, COUNT]
            ints[row, FIRST] = min(ints[row, FIRST], given_ints[i, FIRST])
            ints[row, LAST] = max(ints[row, LAST], given_ints[i, LAST])
        state = np.int64(tags[row, 3])
        if (state & 1) == 0 and counters[2] < dirty.size:
            tags[row, 3] = state | 1
            dirty[counters[2]] = row
            counters[2] += 1
