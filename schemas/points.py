"""A structured dtype and the fields of a ``foxglove.PointCloud``: the one says the other."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from numpy.typing import NDArray

from endo3d.schemas.messages import POINT
from endo3d.schemas.wire import Malformed

_NUMBER: dict[str, int] = {
    "|u1": PackedElementField.UINT8,
    "|i1": PackedElementField.INT8,
    "<u2": PackedElementField.UINT16,
    "<i2": PackedElementField.INT16,
    "<u4": PackedElementField.UINT32,
    "<i4": PackedElementField.INT32,
    "<f4": PackedElementField.FLOAT32,
    "<f8": PackedElementField.FLOAT64,
}
_DTYPE = {number: text for text, number in _NUMBER.items()}

Described = tuple[str, int, int]
"""Name, offset in bytes and ``foxglove.NumericType`` of a field."""


@lru_cache(maxsize=32)
def layout_of(dtype: np.dtype[Any]) -> bytes:
    """The part of a serialised ``foxglove.PointCloud`` that says how points of ``dtype`` lie.

    Raises ``ValueError`` for a field Foxglove has no type for.
    """
    if not dtype.names or dtype.fields is None:
        raise ValueError(f"points are structured; {dtype} has no fields")
    proto = PointCloud(point_stride=dtype.itemsize)
    proto.pose.orientation.w = 1.0
    for name in dtype.names:
        kind, offset = dtype.fields[name][:2]
        if kind.str not in _NUMBER:
            raise ValueError(f"field {name!r} has the type {kind}, which a PointCloud can't name")
        proto.fields.add(name=name, offset=offset, type=_NUMBER[kind.str])
    serialised: bytes = proto.SerializeToString()
    return serialised


@lru_cache(maxsize=32)
def dtype_of(fields: tuple[Described, ...], stride: int) -> np.dtype[Any]:
    """The structured dtype that PointCloud fields describe, ``POINT`` itself if it is that.

    Raises ``Malformed``.
    """
    if not fields:
        raise Malformed("the points have no fields")
    for name, offset, number in fields:
        if number not in _DTYPE:
            raise Malformed(f"field {name!r} has the unknown type {number}")
        if offset + np.dtype(_DTYPE[number]).itemsize > stride:
            raise Malformed(f"field {name!r} ends after the point's {stride} bytes")
    try:
        dtype = np.dtype(
            {
                "names": [name for name, _, _ in fields],
                "formats": [_DTYPE[number] for _, _, number in fields],
                "offsets": [offset for _, offset, _ in fields],
                "itemsize": stride,
            }
        )
    except (ValueError, OverflowError, MemoryError) as error:
        raise Malformed(f"the point's fields make no layout: {error}") from error
    return POINT if dtype == POINT else dtype


def read_fields(proto: Any) -> np.dtype[Any]:
    """The dtype of a received ``foxglove.PointCloud``. Raises ``Malformed``."""
    return dtype_of(tuple((f.name, f.offset, f.type) for f in proto.fields), proto.point_stride)


def view_points(data: memoryview, dtype: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """Points over ``data``; raises ``Malformed`` when they are not ``shape``."""
    if math.prod(shape) * dtype.itemsize != len(data):
        raise Malformed(f"{shape} points of {dtype.itemsize} bytes need another size than {len(data)} bytes")
    return np.ndarray(shape, dtype, data)


def as_point(points: NDArray[Any]) -> NDArray[Any]:
    """Foreign points as ``POINT``: themselves if they are that, else a copy, NaN where a field is absent."""
    if points.dtype == POINT:
        return points
    names = points.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise Malformed(f"points without x, y and z: {', '.join(names) or 'no fields'}")
    copied = np.full(points.shape, np.nan, POINT)
    with np.errstate(over="ignore", invalid="ignore"):
        for name in POINT.names or ():
            if name in names:
                copied[name] = points[name]
    copied.flags.writeable = False
    return copied
