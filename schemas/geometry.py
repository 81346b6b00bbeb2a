"""Stamps and rigid transforms between our messages and Foxglove's."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d.schemas.wire import Malformed

_ROTATION_TOLERANCE = 1e-6
"""How far from a rotation a matrix may be: the drift of float64 over a long chain of poses stays below."""


def fill_stamp(proto: Any, stamp_ns: int) -> None:
    """Into a ``google.protobuf.Timestamp``."""
    proto.seconds, proto.nanos = divmod(stamp_ns, 1_000_000_000)


def read_stamp(proto: Any) -> int:
    """Nanoseconds out of a ``google.protobuf.Timestamp``."""
    nanos: int = proto.nanos
    stamp_ns: int = proto.seconds * 1_000_000_000 + nanos
    if not (0 <= nanos < 1_000_000_000 and -(1 << 63) <= stamp_ns < 1 << 63):
        raise Malformed(f"a stamp of {proto.seconds} s and {nanos} ns is out of range")
    return stamp_ns


def quaternion(R: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """Unit (x, y, z, w) of a (3, 3) rotation, the largest component positive.

    Shepperd's method, dividing by the largest component: J. Guidance and Control 1 (1978) 223.
    Raises ``ValueError`` for anything but a rotation.
    """
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    pivot = max(a, e, i, a + e + i)
    if pivot == a + e + i:
        q = (h - f, c - g, d - b, 1 + pivot)
    elif pivot == a:
        q = (1 + a - e - i, d + b, c + g, h - f)
    elif pivot == e:
        q = (d + b, 1 + e - a - i, h + f, c - g)
    else:
        q = (c + g, h + f, 1 + i - a - e, d - b)
    norm = math.hypot(*q)
    unit = (q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm) if norm > 0 else q
    if not np.allclose(rotation(*unit), R, rtol=0, atol=_ROTATION_TOLERANCE):
        raise ValueError("the upper left 3 x 3 of a transform is not a rotation")
    return unit


def rotation(x: float, y: float, z: float, w: float) -> NDArray[np.float64]:
    """(3, 3) float64 of a unit quaternion."""
    return _rigid(x, y, z, w, (0.0, 0.0, 0.0))[:3, :3]


def _rigid(x: float, y: float, z: float, w: float, t: tuple[float, float, float]) -> NDArray[np.float64]:
    """(4, 4) float64 of a unit quaternion and a translation; from one flat tuple, which numpy takes fastest."""
    return np.array(
        (
            1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), t[0],
            2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), t[1],
            2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), t[2],
            0.0, 0.0, 0.0, 1.0,
        )
    ).reshape(4, 4)  # fmt: skip


def fill_transform(translation: Any, orientation: Any, T: NDArray[np.float64]) -> None:
    """A (4, 4) rigid transform into a ``foxglove.Vector3`` and a ``foxglove.Quaternion``."""
    if T.shape != (4, 4):
        raise ValueError(f"a transform has the shape (4, 4), not {T.shape}")
    translation.x, translation.y, translation.z = T[:3, 3].tolist()
    orientation.x, orientation.y, orientation.z, orientation.w = quaternion(T[:3, :3])


def read_transform(translation: Any, orientation: Any, has_rotation: bool) -> NDArray[np.float64]:
    """(4, 4) float64; an absent rotation is none, a quaternion of another length is normalised."""
    x, y, z, w = orientation.x, orientation.y, orientation.z, orientation.w
    norm = math.hypot(x, y, z, w)
    if not has_rotation:
        w = norm = 1.0
    if not 0 < norm < math.inf:
        raise Malformed(f"({x}, {y}, {z}, {w}) is not a rotation")
    return _rigid(x / norm, y / norm, z / norm, w / norm, (translation.x, translation.y, translation.z))


def read_matrix(values: Any, rows: int, columns: int, what: str) -> NDArray[np.float64]:
    """(rows, columns) float64 of a repeated double, row-major."""
    if len(values) != rows * columns:
        raise Malformed(f"{what} has {len(values)} numbers, not {rows} x {columns}")
    return np.fromiter(values, np.float64, rows * columns).reshape(rows, columns)
