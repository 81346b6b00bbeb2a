"""Rows of values -> a row of points: x x x .. y y y .. z z z .. becomes x y z x y z .., sixteen points at a time.

LLVM stores every float of a point alone, which costs more than computing it. These are its own portable shuffles
between registers instead: one instruction each with AVX-512, a few on narrower machines.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core.cgutils import unpack_tuple
from numba.extending import intrinsic
from numpy.typing import NDArray

from endo3d_core.compiled import kernel

LANES = 16
_LANE = ir.IntType(32)
_ADDRESS = ir.IntType(64)


def _shuffle(builder: Any, first: Any, second: Any, lanes: Sequence[int]) -> Any:
    """Lanes of two vectors, numbered through: the second's follow the first's."""
    mask = ir.Constant(ir.VectorType(_LANE, len(lanes)), [_LANE(lane) for lane in lanes])
    return builder.shuffle_vector(first, second, mask)


def _merge_three(builder: Any, a: Any, b: Any, c: Any) -> list[Any]:
    """a b c a b c ..: three vectors become three."""
    count, merged = a.type.count, []
    for j in range(3):
        places = [divmod(count * j + k, 3) for k in range(count)]
        ab = _shuffle(builder, a, b, [lane + (count if channel == 1 else 0) for lane, channel in places])
        lanes = [k if channel < 2 else count + lane for k, (lane, channel) in enumerate(places)]
        merged.append(_shuffle(builder, ab, c, lanes))
    return merged


def _merge_six(builder: Any, values: Sequence[Any]) -> list[Any]:
    """Six vectors become six: neighbours are paired to 64 bits, then three of these merged as above."""
    wide, narrow = ir.VectorType(ir.DoubleType(), LANES // 2), values[0].type
    halves: list[list[Any]] = [[], []]
    for even, odd in zip(values[::2], values[1::2], strict=True):
        for half in range(2):
            lanes = [half * LANES // 2 + k // 2 + k % 2 * LANES for k in range(LANES)]
            halves[half].append(builder.bitcast(_shuffle(builder, even, odd, lanes), wide))
    return [builder.bitcast(vector, narrow) for half in halves for vector in _merge_three(builder, *half)]


def _packer(channels: int) -> Any:
    """Sixteen columns of rows (channels, width) -> the same points (width, channels), both C-contiguous float32."""

    @intrinsic
    def pack_sixteen(_: Any, rows: Any, column: Any, points: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            source, target = (context.make_array(signature.args[i])(context, builder, arguments[i]) for i in (0, 2))
            row_bytes, _ = unpack_tuple(builder, source.strides, 2)  # type: ignore[no-untyped-call]
            vector = ir.VectorType(ir.FloatType(), LANES)

            def at(base: Any, offset: Any) -> Any:
                address = builder.add(builder.ptrtoint(base, _ADDRESS), offset)
                return builder.inttoptr(address, vector.as_pointer())

            first = builder.mul(arguments[1], _ADDRESS(4))
            values = [
                builder.load(at(source.data, builder.add(first, builder.mul(row_bytes, _ADDRESS(c)))), align=4)
                for c in range(channels)
            ]
            merged = _merge_six(builder, values) if channels == 6 else _merge_three(builder, *values)
            begin = builder.mul(first, _ADDRESS(channels))
            for j, packed in enumerate(merged):
                builder.store(packed, at(target.data, builder.add(begin, _ADDRESS(4 * LANES * j))), align=4)
            return context.get_dummy_value()

        return types.void(rows, column, points), generate

    return pack_sixteen


_pack_six, _pack_three = _packer(6), _packer(3)


@kernel
def pack_points(rows: NDArray[np.float32], points: NDArray[np.float32]) -> None:
    """rows (6, width) -> points (width, 6), both C-contiguous."""
    whole = points.shape[0] // LANES * LANES
    for x in range(0, whole, LANES):
        _pack_six(rows, x, points)
    for x in range(whole, points.shape[0]):
        for c in range(6):
            points[x, c] = rows[c, x]


@kernel
def pack_xyz(rows: NDArray[np.float32], points: NDArray[np.float32]) -> None:
    """rows (3, width) -> points (width, 3), both C-contiguous."""
    whole = points.shape[0] // LANES * LANES
    for x in range(0, whole, LANES):
        _pack_three(rows, x, points)
    for x in range(whole, points.shape[0]):
        for c in range(3):
            points[x, c] = rows[c, x]
