"""A structured dtype and the fields of a ``foxglove.PointCloud``: the one says the other."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
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

FieldText = tuple[str, int, int]
"""Name, offset in bytes, ``foxglove.NumericType``."""


@lru_cache
def fields_of(dtype: np.dtype[Any]) -> tuple[FieldText, ...]:
    """Name, offset and type of every field of a structured dtype, in its own order.

    Raises ``ValueError`` for a field Foxglove has no type for.
    """
    if not dtype.names or dtype.fields is None:
        raise ValueError(f"points are structured; {dtype} has no fields")
    described = []
    for name in dtype.names:
        kind, offset = dtype.fields[name][:2]
        if kind.str not in _NUMBER:
            raise ValueError(f"field {name!r} has the type {kind}, which a PointCloud can't name")
        described.append((name, offset, _NUMBER[kind.str]))
    return tuple(described)


@lru_cache(maxsize=32)
def dtype_of(fields: tuple[FieldText, ...], stride: int) -> np.dtype[Any]:
    """The structured dtype that PointCloud fields describe. Raises ``Malformed``."""
    if not fields:
        raise Malformed("the points have no fields")
    for name, offset, number in fields:
        if number not in _DTYPE:
            raise Malformed(f"field {name!r} has the unknown type {number}")
        if offset + np.dtype(_DTYPE[number]).itemsize > stride:
            raise Malformed(f"field {name!r} ends after the point's {stride} bytes")
    try:
        return np.dtype(
            {
                "names": [name for name, _, _ in fields],
                "formats": [_DTYPE[number] for _, _, number in fields],
                "offsets": [offset for _, offset, _ in fields],
                "itemsize": stride,
            }
        )
    except (ValueError, OverflowError, MemoryError) as error:
        raise Malformed(f"the point's fields make no layout: {error}") from error


def read_fields(proto: Any) -> np.dtype[Any]:
    """The dtype of a received ``foxglove.PointCloud``. Raises ``Malformed``."""
    return dtype_of(tuple((f.name, f.offset, f.type) for f in proto.fields), proto.point_stride)


def view_points(data: memoryview, dtype: np.dtype[Any], shape: Sequence[int]) -> NDArray[Any]:
    """Read-only points over ``data``; raises ``Malformed`` when they are not ``shape``."""
    count = 1
    for length in shape:
        count *= length
    if count * dtype.itemsize != len(data):
        raise Malformed(
            f"{tuple(shape)} points of {dtype.itemsize} bytes need another size than {len(data)} bytes"
        )
    points = np.frombuffer(data, dtype).reshape(shape) if count else np.empty(shape, dtype)
    points.flags.writeable = False
    return points


def as_point(points: NDArray[Any]) -> NDArray[Any]:
    """Foreign points as ``POINT``: themselves where the layout is equal, else a copy, NaN for what is absent."""
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
