"""CDR, little endian, as ROS 2 sends it: member after member, each number aligned to its own size."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from endo3d.services.exchange.ros2_types import DEFINITIONS, PRIMITIVES, Field, fields

HEADER = b"\x00\x01\x00\x00"


def encode(name: str, message: Mapping[str, Any]) -> bytes:
    """The message of that type, as nested mappings; arrays of numbers are numpy arrays or sequences.

    Raises ``KeyError`` for a missing member and ``ValueError`` for an array of the wrong length.
    """
    writer = _Writer()
    writer.message(name, message)
    return b"".join([HEADER, *writer.parts])


class _Writer:
    def __init__(self) -> None:
        self.parts: list[bytes | memoryview] = []
        self.size = 0

    def message(self, name: str, values: Mapping[str, Any]) -> None:
        for field in fields(name):
            self._member(field, values[field.name])

    def _member(self, field: Field, value: Any) -> None:
        if field.count is None:
            self._one(field.type, value)
            return
        if field.count == 0:
            self._number("<u4", len(value))
        elif len(value) != field.count:
            raise ValueError(f"{field.name} has {len(value)} elements instead of {field.count}")
        if field.type in PRIMITIVES:
            self._numbers(PRIMITIVES[field.type][0], value)
        else:
            for element in value:
                self._one(field.type, element)

    def _one(self, kind: str, value: Any) -> None:
        if kind in DEFINITIONS:
            self.message(kind, value)
        elif kind == "string":
            content = value.encode() + b"\0"
            self._number("<u4", len(content))
            self._put(content)
        else:
            self._number(PRIMITIVES[kind][0], value)

    def _number(self, kind: str, value: float) -> None:
        number = np.dtype(kind)
        self._align(number.itemsize)
        self._put(struct.pack("<" + number.char, value))

    def _numbers(self, kind: str, values: Any) -> None:
        numbers = np.ascontiguousarray(values, kind)
        if numbers.size:
            self._align(numbers.itemsize)
            self._put(numbers.reshape(-1).view(np.uint8).data)

    def _align(self, size: int) -> None:
        gap = -self.size % size
        if gap:
            self._put(bytes(gap))

    def _put(self, content: bytes | memoryview) -> None:
        self.parts.append(content)
        self.size += len(content)
