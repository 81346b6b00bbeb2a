"""The merged map (section 3.3): points nearer than the merging distance become one averaged point.

A voxel hash holds one point per voxel: its mean position, normal, intensity and texture, the variance of what was
averaged, the number of measured points, and when it was first and last seen. A point whose voxel is empty joins
the neighbour along the viewing axis if that lies within the merging distance: noise along the ray never splits
a surface that lies on a voxel face.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d_core import pooling, voxel_hash
from endo3d_core.compiled import kernel
from endo3d_core.pooling import GX, GY, GZ, NX, NY, NZ, X, Y, Z

MAP_POINT = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz", "intensity", "sigma")]
    + [(name, "<i4") for name in ("count", "first_seen", "last_seen")]
    + [(name, "<i2") for name in ("kx", "ky", "kz")]
    + [("spare", "<i2")]
)
"""One merged point: position in mm in the world, unit normal towards where it was seen from, intensity in grey
values, sigma in mm (standard deviation of the measured points along the normal; that of the mean is
sigma / sqrt(count)), measured points, sequence numbers of the first and last cloud, voxel key."""

# A row is one cache line: 16 float32, seen as int32 too. Beside it lies a tag of four int16.
POS, NORMAL, GREY, VARIANCE, WEIGHT, TEXTURE, GRADIENT = 0, 3, 6, 7, 8, 9, 10
COUNT, FIRST, LAST = 13, 14, 15  # int32
ROW = 16
KEY, PUBLISHED = 0, 3  # of the tag
TAG = 4

CONFIRMED = 8
"""Measured points from which on a map point is believed and published."""
SETTLED = 16
"""Measured points from which on one more changes little: a map point's noise is a quarter of one's."""
_SETTLED_SHARE = 0.9
"""Of the map points that a cloud fell onto: if more had settled, the next cloud is merged by half."""
_OUTLIER_AGE = 60
"""Clouds after which a map point that is still unconfirmed is an outlier (a third of a second)."""
_CROWDED = 0.95
"""Share of the capacity from which on the points seen longest ago are forgotten."""
_SWEPT = 4096
"""Rows looked at for eviction per cloud: a fixed cost instead of a pause."""
_MOVED_MM = 0.002
"""A published point is published again when its mean has moved so far along the normal."""


@dataclass(frozen=True, slots=True)
class Delta:
    """What changed since the last one."""

    points: NDArray[np.void]
    """(n,) MAP_POINT."""
    removed: NDArray[np.int16]
    """(m, 3) voxel keys."""


class MergedMap:
    """Points of ``capacity`` voxels of ``merging_distance_mm``; memory is bounded by about 120 bytes for each."""

    def __init__(self, merging_distance_mm: float = 0.075, capacity: int = 1_000_000) -> None:
        if not 0.001 <= merging_distance_mm <= 10.0:
            raise ValueError(f"a merging distance of {merging_distance_mm} mm is not within 0.001..10")
        self.merging_distance_mm = merging_distance_mm
        self.capacity = capacity
        # The hash table, its rows and their bookkeeping: ``map_rows`` works on them too.
        slots = 1 << max(math.ceil(math.log2(2 * capacity)), 4)
        self.keys = np.full(slots, voxel_hash.EMPTY, np.int64)
        self.index = np.zeros(slots, np.int32)
        self.rows = np.zeros((capacity, ROW), np.float32)
        self.ints = self.rows.view(np.int32)
        self.tags = np.zeros((capacity, TAG), np.int16)
        self.moved = np.zeros(capacity, np.float32)
        self.free = np.empty(capacity, np.int32)
        self.dirty = np.empty(capacity, np.int32)
        self._removed = np.empty((capacity, 3), np.int16)
        self._touched = np.empty(0, np.int32)
        self._turn = 0
        self.counters = np.zeros(10, np.int64)
        self.clear()

    def clear(self) -> None:
        self.keys[:] = voxel_hash.EMPTY
        self.ints[: self.used, COUNT] = 0
        self.counters[:] = 0

    # The kernels' counters: rows ever used, free rows, dirty rows, removed keys, touched rows, sweep position, refused
    # points, first cloud, and of the last cloud: voxels that were there, and those of them that had settled.
    @property
    def used(self) -> int:
        """Rows in use or free again: every live row lies below."""
        return int(self.counters[0])

    @property
    def count(self) -> int:
        """Map points, unconfirmed ones included."""
        return int(self.counters[0] - self.counters[1])

    @property
    def refused(self) -> int:
        """Points that found no room since the map was made."""
        return int(self.counters[6])

    @property
    def touched(self) -> NDArray[np.int32]:
        """Rows that the last cloud was merged into, in the order of its grid: the visible part of the map."""
        return self._touched[: self.counters[4]]

    def merge(self, live: NDArray[np.float32], T_world_camera: NDArray[np.float64], sequence: int) -> None:
        """Merges a cloud ``live`` (PLANES, rows, columns), seen from a pose (4, 4), as cloud ``sequence``.

        Where nearly everything in view has settled, only every second line is merged, even and odd ones in turn.
        """
        if self.count == 0:
            self.counters[7] = sequence
        if self._touched.size < live[Z].size:
            self._touched = np.empty(live[Z].size, np.int32)
            self._world = np.empty((3, live.shape[2]), np.float32)
            self._voxels, self._found = np.empty(live.shape[2], np.int64), np.empty(live.shape[2], np.int32)
        halved = self.counters[9] > _SETTLED_SHARE * self.counters[8]
        self._turn = 1 - self._turn if halved else 0
        _merge(
            live, np.ascontiguousarray(T_world_camera, np.float64), self.merging_distance_mm, sequence,
            self._turn, 2 if halved else 1, self.keys, self.index, self.rows, self.ints, self.tags, self.moved,
            self.free, self.dirty, self._touched, self._world, self._voxels, self._found, self.counters,
        )  # fmt: skip
        _sweep(
            sequence, min(_SWEPT, self.used), self.keys, self.index, self.ints, self.tags,
            self.free, self._removed, self.counters,
        )  # fmt: skip

    def confirmed(self, at_least: int = CONFIRMED) -> NDArray[np.int32]:
        """Row numbers of points with ``at_least`` so many measured points."""
        return np.flatnonzero(self.ints[: self.used, COUNT] >= at_least).astype(np.int32)

    def points(self, at_least: int = CONFIRMED) -> NDArray[np.void]:
        """A copy of the confirmed points, (n,) MAP_POINT."""
        return self._published(self.confirmed(at_least))

    def take_delta(self) -> Delta:
        """What is new, moved by more than 2 um or doubled its count since the last call."""
        dirty = np.unique(self.dirty[: self.counters[2]])
        dirty = dirty[self.ints[dirty, COUNT] >= CONFIRMED]
        delta = Delta(self._published(dirty), self._removed[: self.counters[3]].copy())
        _mark_published(dirty, self.ints, self.tags, self.moved)
        self.counters[2:4] = 0
        return delta

    def _published(self, rows: NDArray[np.int32]) -> NDArray[np.void]:
        out = np.zeros(len(rows), MAP_POINT)
        values, ints, tags = self.rows[rows], self.ints[rows], self.tags[rows]
        for i, name in enumerate(("x", "y", "z", "nx", "ny", "nz", "intensity")):
            out[name] = values[:, i]
        out["sigma"] = np.sqrt(values[:, VARIANCE])
        for i, name in enumerate(("count", "first_seen", "last_seen")):
            out[name] = ints[:, COUNT + i]
        for i, name in enumerate(("kx", "ky", "kz")):
            out[name] = tags[:, KEY + i]
        return out


@kernel
def _along_axis(keys: Any, index: Any, rows: Any, key: Any, axis: Any, place: Any, d: Any) -> Any:
    """The row of the voxel before or behind along ``axis`` whose point lies within d of ``place``, or -1."""
    best: Any = np.int64(-1)
    best_gap = np.float32(d)
    stride = np.int64(1) << (32 - 16 * axis)
    for neighbour in (key - stride, key + stride):
        row = voxel_hash.find(keys, index, neighbour)
        if row >= 0:
            gap = abs(rows[row, axis] - place)
            if gap < best_gap:
                best, best_gap = row, gap
    return best


@kernel
def _place(
    live: Any, r: Any, T: Any, per_voxel: Any, xs: NDArray[np.float32], ys: NDArray[np.float32],
    zs: NDArray[np.float32], voxels: NDArray[np.int64],
) -> Any:  # fmt: skip
    """One line of the cloud in the world: points and voxel keys, EMPTY where invalid; returns those out of range."""
    r00, r01, r02, tx = np.float32(T[0, 0]), np.float32(T[0, 1]), np.float32(T[0, 2]), np.float32(T[0, 3])
    r10, r11, r12, ty = np.float32(T[1, 0]), np.float32(T[1, 1]), np.float32(T[1, 2]), np.float32(T[1, 3])
    r20, r21, r22, tz = np.float32(T[2, 0]), np.float32(T[2, 1]), np.float32(T[2, 2]), np.float32(T[2, 3])
    px, py, pz = live[X, r], live[Y, r], live[Z, r]
    scale, offset = np.float32(per_voxel), np.float32(voxel_hash.OFFSET)
    one, end = np.float32(1.0), np.float32(2 * voxel_hash.OFFSET - 2)
    beyond = 0
    for c in range(voxels.size):
        a, b, e = px[c], py[c], pz[c]
        x, y, z = r00 * a + r01 * b + r02 * e + tx, r10 * a + r11 * b + r12 * e + ty, r20 * a + r21 * b + r22 * e + tz
        # Positive, so that cutting off the fraction rounds down.
        fx, fy, fz = x * scale + offset, y * scale + offset, z * scale + offset
        inside = (min(fx, min(fy, fz)) > one) & (max(fx, max(fy, fz)) < end)
        key = (np.int64(fx) << 32) | (np.int64(fy) << 16) | np.int64(fz)
        voxels[c] = key if inside else np.int64(voxel_hash.EMPTY)
        beyond += 1 if (not inside) & (e == e) else 0
        xs[c], ys[c], zs[c] = x, y, z
    return beyond


@kernel
def _find_all(keys: Any, index: Any, ints: Any, voxels: NDArray[np.int64], found: NDArray[np.int32]) -> Any:
    """The row of each voxel, -1 where there is none; returns how many there are and how many of them are settled.

    Apart from the update, so that the processor waits for many cache misses at a time.
    """
    known = settled = 0
    for c in range(voxels.size):
        row = voxel_hash.find(keys, index, voxels[c]) if voxels[c] != voxel_hash.EMPTY else np.int64(-1)
        found[c] = row
        known += 1 if row >= 0 else 0
        settled += 1 if (ints[max(row, 0), COUNT] >= SETTLED) & (row >= 0) else 0
    return known, settled


@kernel
def _merge(
    live: Any, T: Any, d: Any, sequence: Any, first: Any, step: Any, keys: Any, index: Any, rows: Any, ints: Any,
    tags: Any, moved: Any, free: Any, dirty: Any, touched: Any, world: Any, voxels: Any, found: Any, counters: Any,
) -> None:  # fmt: skip
    r00, r01, r02 = np.float32(T[0, 0]), np.float32(T[0, 1]), np.float32(T[0, 2])
    r10, r11, r12 = np.float32(T[1, 0]), np.float32(T[1, 1]), np.float32(T[1, 2])
    r20, r21, r22 = np.float32(T[2, 0]), np.float32(T[2, 1]), np.float32(T[2, 2])
    axis = 2
    if abs(r02) > abs(r12) and abs(r02) > abs(r22):
        axis = 0
    elif abs(r12) > abs(r22):
        axis = 1
    one = np.float32(1.0)
    touches, waiting, refused, known, settled = 0, counters[2], counters[6], 0, 0
    xs, ys, zs = world[0], world[1], world[2]
    for r in range(first, live.shape[1], step):
        refused += _place(live, r, T, one / np.float32(d), xs, ys, zs, voxels)
        known_here, settled_here = _find_all(keys, index, ints, voxels, found)
        known, settled = known + known_here, settled + settled_here
        for c in range(voxels.size):
            if voxels[c] == voxel_hash.EMPTY:
                continue
            x, y, z = xs[c], ys[c], zs[c]
            row: Any = np.int64(found[c])
            if row < 0:
                key = voxels[c]
                row = voxel_hash.find(keys, index, key)
                if row < 0:
                    place = x if axis == 0 else (y if axis == 1 else z)
                    row = _along_axis(keys, index, rows, key, axis, place, d)
                if row < 0:
                    if counters[1] > 0:
                        counters[1] -= 1
                        row = np.int64(free[counters[1]])
                    elif counters[0] < rows.shape[0]:
                        row = counters[0]
                        counters[0] += 1
                    else:
                        refused += 1
                        continue
                    voxel_hash.insert(keys, index, key, row)
                    kx, ky, kz = voxel_hash.unpack(key)
                    rows[row] = np.float32(0.0)
                    rows[row, 0], rows[row, 1], rows[row, 2] = x, y, z
                    tags[row, 0], tags[row, 1], tags[row, 2], tags[row, PUBLISHED] = kx, ky, kz, 0
                    moved[row] = np.float32(0.0)
                    ints[row, FIRST] = sequence
                    ints[row, LAST] = sequence - 1
            point = rows[row]
            point[WEIGHT] += live[pooling.WEIGHT, r, c]
            share = live[pooling.WEIGHT, r, c] / point[WEIGHT]
            dx, dy, dz = x - point[0], y - point[1], z - point[2]
            point[0] += share * dx
            point[1] += share * dy
            point[2] += share * dz
            a, b, e = live[NX, r, c], live[NY, r, c], live[NZ, r, c]
            if a == a:
                nx, ny, nz = r00 * a + r01 * b + r02 * e, r10 * a + r11 * b + r12 * e, r20 * a + r21 * b + r22 * e
                fresh = point[3] * point[3] + point[4] * point[4] + point[5] * point[5] == np.float32(0.0)
                blend = one if fresh else share
                nx, ny, nz = (
                    point[3] + blend * (nx - point[3]),
                    point[4] + blend * (ny - point[4]),
                    point[5] + blend * (nz - point[5]),
                )
                scale = one / np.sqrt(nx * nx + ny * ny + nz * nz)
                point[3], point[4], point[5] = nx * scale, ny * scale, nz * scale
            off = point[3] * dx + point[4] * dy + point[5] * dz
            point[VARIANCE] = (one - share) * (point[VARIANCE] + share * off * off)
            moved[row] += share * off
            point[GREY] += share * (live[pooling.GREY, r, c] - point[GREY])
            point[TEXTURE] += share * (live[pooling.TEXTURE, r, c] - point[TEXTURE])
            a, b, e = live[GX, r, c], live[GY, r, c], live[GZ, r, c]
            if a == a:
                point[10] += share * (r00 * a + r01 * b + r02 * e - point[10])
                point[11] += share * (r10 * a + r11 * b + r12 * e - point[11])
                point[12] += share * (r20 * a + r21 * b + r22 * e - point[12])
            ints[row, COUNT] += 1
            if ints[row, LAST] != sequence:
                ints[row, LAST] = sequence
                touched[touches] = row
                touches += 1
            # Published holds twice the exponent of the last published count, plus one while the row waits.
            state = np.int64(tags[row, PUBLISHED])
            doubled = (ints[row, COUNT] >> (state >> 1)) > 1
            changed = state == 0 or doubled or abs(moved[row]) > np.float32(_MOVED_MM)
            if (state & 1) == 0 and ints[row, COUNT] >= CONFIRMED and changed and waiting < dirty.size:
                tags[row, PUBLISHED] = state | 1
                dirty[waiting] = row
                waiting += 1
    counters[4], counters[2], counters[6] = touches, waiting, refused
    counters[8], counters[9] = known, settled


@kernel
def _mark_published(dirty: Any, ints: Any, tags: Any, moved: Any) -> Any:
    for i in range(dirty.size):
        row = dirty[i]
        exponent = 0
        while (ints[row, COUNT] >> (exponent + 1)) > 0:
            exponent += 1
        tags[row, PUBLISHED] = 2 * exponent
        moved[row] = np.float32(0.0)


@kernel
def _sweep(
    sequence: Any, amount: Any, keys: Any, index: Any, ints: Any, tags: Any, free: Any, removed: Any, counters: Any
) -> None:  # fmt: skip
    """Looks at the next ``amount`` rows and evicts those that were never confirmed (section 3.3: outliers).

    In a map that is nearly full, also what was not seen during the later half of the scan.
    """
    used = counters[0]
    crowded = used - counters[1] > _CROWDED * ints.shape[0]
    for _ in range(amount):
        row = counters[5]
        counters[5] = row + 1 if row + 1 < used else 0
        if ints[row, COUNT] == 0:
            continue
        outlier = ints[row, COUNT] < CONFIRMED and sequence - ints[row, LAST] > _OUTLIER_AGE
        forgotten = crowded and 2 * ints[row, LAST] < sequence + counters[7]
        if outlier or forgotten:
            if tags[row, PUBLISHED] > 0 and counters[3] < removed.shape[0]:
                removed[counters[3]] = tags[row, :3]
                counters[3] += 1
            voxel_hash.remove(
                keys, index,
                voxel_hash.pack(np.int64(tags[row, 0]), np.int64(tags[row, 1]), np.int64(tags[row, 2])),
            )  # fmt: skip
            ints[row, COUNT] = 0
            free[counters[1]] = row
            counters[1] += 1
