"""The large array is never copied, and a header always fits in front of it."""

from __future__ import annotations

import dataclasses
import gc
import tracemalloc
import weakref

import numpy as np
import pytest
from any_message import example

from endo3d.schemas import codec, topics
from endo3d.schemas.messages import POINT

BULK = {
    topics.FRAME: ("image", (1200, 1920), np.dtype(np.uint8)),
    topics.CLOUD: ("points", (300, 480), POINT),
    topics.DEPTH: ("depth", (600, 960), np.dtype(np.uint16)),
}
every_bulk_topic = pytest.mark.parametrize("topic", BULK, ids=lambda topic: topic.name)


def lent(topic):
    """A slot, and a message whose array stands in it."""
    name, shape, dtype = BULK[topic]
    slot = np.zeros(codec.DATA_OFFSET + int(np.prod(shape)) * dtype.itemsize, np.uint8)
    array = np.ndarray(shape, dtype, slot, codec.DATA_OFFSET)
    slot[codec.DATA_OFFSET :] = np.arange(slot.size - codec.DATA_OFFSET) % 251
    return slot, dataclasses.replace(example(topic), **{name: array})


def allocated(work):
    """The most bytes that ``work`` held at once, and its result."""
    work()
    gc.collect()
    tracemalloc.start()
    try:
        result = work()
        return tracemalloc.get_traced_memory()[1], result
    finally:
        tracemalloc.stop()


def address(array):
    return array.__array_interface__["data"][0]


def test_the_bulk_topics_are_these():
    assert {topic for topic in topics.TOPICS if topic.bulk} == set(BULK)
    assert codec.DATA_OFFSET % 64 == 0


@every_bulk_topic
def test_encoding_in_place_copies_nothing(topic):
    slot, message = lent(topic)
    assert codec.encoded_size(message) == slot.size
    pixels = slot[codec.DATA_OFFSET :].copy()
    held, size = allocated(lambda: codec.encode_into(message, slot))
    assert size == slot.size
    assert held < 20_000 < slot.size
    np.testing.assert_array_equal(slot[codec.DATA_OFFSET :], pixels)


@every_bulk_topic
def test_decoding_copies_nothing(topic):
    slot, message = lent(topic)
    codec.encode_into(message, slot)
    held, decoded = allocated(lambda: codec.decode(topic, slot))
    assert held < 20_000 < slot.size
    array = codec.array_of(decoded)
    assert address(array) == address(slot) + codec.DATA_OFFSET
    assert np.shares_memory(array, slot)
    assert array.flags.c_contiguous
    np.testing.assert_array_equal(array, codec.array_of(message))


def test_a_map_is_a_view_too():
    delta = example(topics.MAP)
    encoded = codec.encode(delta)
    decoded = codec.decode(topics.MAP, encoded)
    assert np.shares_memory(decoded.points, np.frombuffer(encoded, np.uint8))
    start, stop = codec.data_span(encoded)
    assert (start % 64, stop) == (0, len(encoded))


@every_bulk_topic
def test_an_array_from_elsewhere_is_copied_into_place(topic):
    slot, message = lent(topic)
    other = np.zeros_like(slot)
    codec.encode_into(message, slot)
    codec.encode_into(message, other)
    np.testing.assert_array_equal(slot, other)


def test_a_sample_can_be_shifted_within_its_own_slot():
    slot, message = lent(topics.FRAME)
    image = message.image.copy()
    shifted = dataclasses.replace(message, image=message.image[1:])
    codec.encode_into(shifted, slot)
    np.testing.assert_array_equal(
        codec.decode(topics.FRAME, slot[: codec.encoded_size(shifted)]).image, image[1:]
    )


@every_bulk_topic
def test_views_are_read_only_and_keep_the_slot_alive(topic):
    slot, message = lent(topic)
    codec.encode_into(message, slot)
    del message
    alive = weakref.ref(slot)
    array = codec.array_of(codec.decode(topic, slot))
    del slot
    with pytest.raises(ValueError, match="read-only"):
        array[0, 0] = array[0, 1]
    gc.collect()
    assert alive() is not None
    del array
    gc.collect()
    assert alive() is None


@every_bulk_topic
def test_the_longest_header_fits(topic):
    """All numbers at their longest, and more text than any pattern set needs."""
    longest = {
        "stamp_ns": -1,
        "trigger_ns": -1,
        "newest_stamp_ns": -1,
        "sequence": 2**64 - 1,
        "epoch": 2**64 - 1,
        "camera_frame_id": 2**64 - 1,
        "valid_count": 2**64 - 1,
        "slot_slips": 2**64 - 1,
        "window_frames": 2**32 - 1,
        "slot": -(2**31),
        "exposure_us": 1 / 3,
        "scale_mm": 1 / 3,
        "offset_mm": 1 / 3,
        "grid_px": 1 / 3,
        "pattern_set": "x" * 512,
        "frame_id": "y" * 128,
    }
    slot, message = lent(topic)
    known = {field.name for field in dataclasses.fields(message)}
    message = dataclasses.replace(
        message, **{name: value for name, value in longest.items() if name in known}
    )
    assert codec.encode_into(message, slot) == slot.size
    decoded = codec.decode(topic, slot)
    assert all(getattr(decoded, name) == value for name, value in longest.items() if name in known)


def test_a_header_that_is_too_long_is_refused():
    slot, message = lent(topics.FRAME)
    endless = dataclasses.replace(message, pattern_set="x" * codec.DATA_OFFSET)
    with pytest.raises(ValueError, match="shorten"):
        codec.encode_into(endless, slot)
    with pytest.raises(ValueError, match="shorten"):
        codec.encode(endless)


def test_a_slot_that_is_too_small_is_refused():
    slot, message = lent(topics.FRAME)
    with pytest.raises(ValueError, match="don't fit"):
        codec.encode_into(message, slot[:-1])


def test_only_bulk_messages_go_in_place():
    assert codec.array_of(example(topics.MAP)) is None
    assert codec.array_of(example(topics.LOG)) is None
    with pytest.raises(ValueError, match="not bulk"):
        codec.encode_into(example(topics.MAP), bytearray(10_000))
    with pytest.raises(ValueError, match="not bulk"):
        codec.encoded_size(example(topics.LOG))
