"""Keyframes: poses along the way, the part of the map each of them has seen last, and how the world moved since.

Everything is kept as it was tracked (in ``odom``, the tracker's own world). The pose graph says where the keyframes
really were; what lies between two of them moves with both, by its place in the sequence of clouds.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from endo3d_core import rigid
from endo3d_core.compiled import kernel
from endo3d_core.map_rows import Rows
from endo3d_core.merging import FIRST, LAST, ROW
from endo3d_core.pose_graph import PoseGraph

Array = NDArray[np.float64]


class Keyframes:
    """At most ``capacity`` map points are kept, 64 bytes each; what comes later is counted as refused."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.graph = PoseGraph()
        self.sequences: list[int] = []
        self.stamps_ns: list[int] = []
        self.T_odom_camera: list[Array] = []
        self.centres: list[Array] = []
        """(3,) mm in odom: the middle of what each sees."""
        self.points = 0
        self.refused = 0
        self._joined: list[bool] = []
        self._parts: list[list[Rows]] = []

    def __len__(self) -> int:
        return len(self.sequences)

    def add(
        self, sequence: int, stamp_ns: int, T_odom_camera: Array, centre: Array, information: Array, joined: bool
    ) -> int:
        """A keyframe; its number. ``joined``: the path from the last one to it is unbroken."""
        before = self.T_odom_camera[-1] if len(self) else np.eye(4)
        self.sequences.append(sequence)
        self.stamps_ns.append(stamp_ns)
        self.T_odom_camera.append(T_odom_camera)
        self.centres.append(centre)
        self._joined.append(joined)
        self._parts.append([])
        return self.graph.add(rigid.inverse(before) @ T_odom_camera, information)

    def keep(self, rows: Rows) -> None:
        """Finished rows in odom: each goes to the keyframe it was seen around."""
        room = self.capacity - self.points
        self.refused += max(len(rows) - room, 0)
        rows = rows[:room]
        if not len(rows):
            return
        owner, _ = self._place(middle(rows))
        for k in np.unique(owner):
            self._parts[k].append(rows[owner == k])
        self.points += len(rows)

    def part(self, k: int) -> Rows:
        """What keyframe ``k`` keeps, in odom."""
        if len(self._parts[k]) > 1:
            self._parts[k] = [np.concatenate(self._parts[k])]
        return self._parts[k][0] if self._parts[k] else np.empty((0, ROW), np.float32)

    def corrections(self) -> Array:
        """(n, 4, 4) T_world_odom around each keyframe."""
        corrected: Array = self.graph.poses @ rigid.inverse(np.array(self.T_odom_camera))
        return corrected

    def corrected(self, sequences: NDArray[np.int64], T_odom_camera: Array) -> Array:
        """Poses (m, 4, 4) of clouds ``sequences`` (m,) as tracked -> T_world_camera."""
        return correct(np.array(self.sequences), self.corrections(), sequences, T_odom_camera, np.array(self._joined))

    def warped(self, rows: Rows) -> Rows:
        """Rows in odom -> a copy in the world."""
        owner, share = self._place(middle(rows))
        C = self.corrections().astype(np.float32)
        out = np.empty((len(rows), ROW), np.float32)
        _warp(np.ascontiguousarray(rows), owner, share.astype(np.float32), C, out)
        return out

    def _place(self, sequences: Array) -> tuple[NDArray[np.int64], Array]:
        return between(np.array(self.sequences), sequences, np.array(self._joined))


def middle(rows: Rows) -> Array:
    """(n,): the middle of the clouds that saw each row."""
    ints = np.ascontiguousarray(rows).view(np.int32)
    return 0.5 * (ints[:, FIRST].astype(np.float64) + ints[:, LAST])


def between(keyframes: NDArray[Any], sequences: NDArray[Any], joined: NDArray[np.bool_]) -> tuple[Any, Array]:
    """Which keyframe came before each cloud, and how far on to the next it is (0..1; 0 where the path is broken)."""
    k = np.clip(np.searchsorted(keyframes, sequences, "right") - 1, 0, len(keyframes) - 1)
    after = np.minimum(k + 1, len(keyframes) - 1)
    length = keyframes[after] - keyframes[k]
    share = np.where((length > 0) & joined[after], (sequences - keyframes[k]) / np.maximum(length, 1), 0.0)
    return k, np.clip(share, 0.0, 1.0)


def correct(
    keyframes: NDArray[Any],
    T_world_odom: Array,
    sequences: NDArray[Any],
    T_odom_camera: Array,
    joined: NDArray[np.bool_],
) -> Array:
    """Poses (m, 4, 4) as tracked -> in the world, from the correction (n, 4, 4) at each keyframe."""
    k, share = between(keyframes, sequences, joined)
    here, after = T_world_odom[k], T_world_odom[np.minimum(k + 1, len(keyframes) - 1)]
    D = rigid.inverse(here) @ after
    part = np.tile(np.eye(4), (len(k), 1, 1))
    part[:, :3, :3] = Rotation.from_rotvec(
        share[:, None] * Rotation.from_matrix(D[:, :3, :3]).as_rotvec()
    ).as_matrix()
    part[:, :3, 3] = share[:, None] * D[:, :3, 3]
    corrected: Array = here @ part @ T_odom_camera
    return corrected


@kernel
def _warp(rows: Any, owner: Any, share: Any, C: Any, out: Any) -> None:
    """Position, normal and texture gradient by the mean of two corrections, which differ by far less than a degree."""
    one = np.float32(1.0)
    for i in range(rows.shape[0]):
        k, s = owner[i], share[i]
        n = min(k + 1, C.shape[0] - 1)
        for j in range(rows.shape[1]):
            out[i, j] = rows[i, j]
        for first in (0, 3, 10):
            x, y, z = rows[i, first], rows[i, first + 1], rows[i, first + 2]
            for axis in range(3):
                a, b = C[k, axis], C[n, axis]
                moved = (one - s) * (a[0] * x + a[1] * y + a[2] * z) + s * (b[0] * x + b[1] * y + b[2] * z)
                if first == 0:
                    moved += (one - s) * a[3] + s * b[3]
                out[i, first + axis] = moved
