"""The wire format against the protobuf library's own reading of it."""

from __future__ import annotations

import time

import pytest
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.internal import decoder, encoder
from hypothesis import given
from hypothesis import strategies as st

from endo3d.schemas import wire

DATA = 6
numbers = st.integers(0, 2**64 - 1)
payloads = st.binary(max_size=200)
tags = st.integers(8, 500)
"""Field numbers that RawImage doesn't know."""


def field(number: int, payload: bytes) -> bytes:
    return encoder.TagBytes(number, 2) + encoder._VarintBytes(len(payload)) + payload


other_fields = st.one_of(
    st.builds(field, tags, payloads),
    st.builds(lambda tag, value: encoder.TagBytes(tag, 0) + encoder._VarintBytes(value), tags, numbers),
    st.builds(lambda tag, raw: encoder.TagBytes(tag, 1) + raw, tags, st.binary(min_size=8, max_size=8)),
    st.builds(lambda tag, raw: encoder.TagBytes(tag, 5) + raw, tags, st.binary(min_size=4, max_size=4)),
)


@given(numbers)
def test_varints_are_the_librarys(value):
    encoded = wire.varint(value)
    assert encoded == encoder._VarintBytes(value)
    assert wire.read_varint(memoryview(encoded + b"\xff"), 0) == (value, len(encoded))
    assert decoder._DecodeVarint(encoded, 0) == (value, len(encoded))


@given(numbers, st.integers(0, 9))
def test_a_cut_varint_is_malformed(value, kept):
    encoded = wire.varint(value)
    with pytest.raises(wire.Malformed, match="cut off"):
        wire.read_varint(memoryview(encoded[: min(kept, len(encoded) - 1)]), 0)


def test_an_endless_varint_is_malformed():
    with pytest.raises(wire.Malformed, match="ten bytes"):
        wire.read_varint(memoryview(b"\xff" * 20), 0)


@given(st.lists(st.one_of(other_fields, payloads.map(lambda payload: field(DATA, payload))), max_size=12))
def test_the_span_is_what_the_library_reads(fields):
    """Fields in any order, of any type, ``data`` any number of times: the last one counts."""
    buffer = memoryview(b"".join(fields))
    start, first, last = wire.span(buffer, DATA)
    read = RawImage.FromString(bytes(buffer)).data
    assert bytes(buffer[first:last]) == read
    assert start == last == len(buffer) or bytes(buffer[start:last]) == field(DATA, read)


@given(st.binary(max_size=64), st.integers(0, 3_000_000), st.integers(2, 20))
def test_front_puts_the_array_where_it_belongs(payload, length, steps):
    header = field(7, payload.hex().encode())
    offset = 64 * steps
    least = wire.room(header, DATA, length, 64)
    if offset < least:
        with pytest.raises(ValueError, match="too long"):
            wire.front(header, DATA, length, offset)
        return
    before = wire.front(header, DATA, length, offset)
    assert len(before) == offset
    assert before.startswith(header)
    image = RawImage.FromString(before + bytes(length))
    assert len(image.data) == length
    assert image.frame_id == payload.hex()


@pytest.mark.parametrize("gap", range(6))
def test_every_gap_can_be_filled(gap):
    """The padding's own tag and length take four bytes: no gap is left that they don't fit."""
    offset = 1024
    last = wire.field_front(DATA, 10)
    header = field(7, b"x" * (offset - len(last) - 4 - gap - 3))
    assert len(header) == offset - len(last) - 4 - gap
    assert len(wire.front(header, DATA, 10, offset)) == offset


@pytest.mark.parametrize(
    ("raw", "says"),
    [
        (b"\x32\x05abcd", "after the message"),
        (b"\x32\xff\xff\xff\xff\xff\xff\xff\xff\xff\x01", "after the message"),
        (b"\x15\x00\x00\x00", "after the message"),
        (b"\x11\x00\x00\x00", "after the message"),
        (b"\x0b", "wire type 3"),
        (b"\x0c", "wire type 4"),
        (b"\x0f", "wire type 7"),
        (b"\x08", "cut off"),
        (b"\x08\x01" * (wire.MOST_FIELDS + 1), "fields"),
    ],
)
def test_what_is_no_message(raw, says):
    with pytest.raises(wire.Malformed, match=says):
        wire.span(memoryview(raw), DATA)


def test_a_million_fields_cost_no_time():
    flood = memoryview(b"\x08\x01" * 1_000_000)
    started = time.process_time()
    with pytest.raises(wire.Malformed, match="fields"):
        wire.span(flood, DATA)
    assert time.process_time() - started < 0.2
