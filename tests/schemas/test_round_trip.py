"""Every message survives its bytes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from any_message import MESSAGES, assert_equal, example
from hypothesis import given
from hypothesis import strategies as st

from endo3d.schemas import codec, topics

every_topic = pytest.mark.parametrize("topic", topics.TOPICS, ids=lambda topic: topic.name)
any_message = st.sampled_from(topics.TOPICS).flatmap(lambda topic: MESSAGES[topic])
any_bulk_message = st.sampled_from([t for t in topics.TOPICS if t.bulk]).flatmap(
    lambda topic: MESSAGES[topic]
)


@every_topic
@given(st.data())
def test_a_message_survives(topic, data):
    message = data.draw(MESSAGES[topic])
    assert_equal(codec.decode(topic, codec.encode(message)), message)


@given(any_message)
def test_equal_messages_give_equal_bytes(message):
    assert codec.encode(dataclasses.replace(message)) == codec.encode(message)


@pytest.mark.parametrize(
    "topic",
    [t for t in topics.TOPICS if t not in (topics.POSE, topics.PART_POSE, topics.TRANSFORM)],
    ids=lambda topic: topic.name,
)
def test_what_was_decoded_encodes_to_the_same_bytes(topic):
    """Of a pose, only its first encoding is exact: Foxglove's rotation is a quaternion."""
    encoded = codec.encode(example(topic))
    assert codec.encode(codec.decode(topic, encoded)) == encoded


@given(any_bulk_message)
def test_in_place_and_plain_give_the_same_bytes(message):
    buffer = np.full(codec.encoded_size(message) + 100, 0xAA, np.uint8)
    size = codec.encode_into(message, buffer)
    assert bytes(buffer[:size]) == codec.encode(message)
    assert (buffer[size:] == 0xAA).all()


@every_topic
@pytest.mark.parametrize("kind", [bytes, bytearray, memoryview, lambda b: np.frombuffer(b, np.uint8)])
def test_any_buffer_decodes(topic, kind):
    encoded = codec.encode(example(topic))
    assert_equal(codec.decode(topic, kind(encoded)), example(topic))


def test_numpy_numbers_are_numbers():
    plain = example(topics.FRAME)
    numpy_like = dataclasses.replace(
        plain,
        stamp_ns=np.int64(plain.stamp_ns),
        sequence=np.uint32(plain.sequence),
        slot=np.int32(plain.slot),
        exposure_us=np.float64(plain.exposure_us),
    )
    assert codec.encode(numpy_like) == codec.encode(plain)
    mode = example(topics.MODE)
    assert codec.encode(dataclasses.replace(mode, running=np.bool_(True))) == codec.encode(mode)


def test_strided_arrays_are_gathered():
    frame = example(topics.FRAME)
    wide = np.zeros((4, 12), np.uint8)
    wide[:, ::2] = frame.image
    strided = dataclasses.replace(frame, image=wide[:, ::2])
    assert codec.encode(strided) == codec.encode(frame)
    buffer = np.zeros(codec.encoded_size(strided), np.uint8)
    codec.encode_into(strided, buffer)
    assert bytes(buffer) == codec.encode(frame)


@pytest.mark.parametrize(
    ("topic", "change", "says"),
    [
        (topics.FRAME, {"image": np.zeros((0, 4), np.uint8)}, "height, width"),
        (topics.FRAME, {"image": np.zeros((2, 2), np.float32)}, "mono8 or mono16"),
        (topics.FRAME, {"image": np.zeros((2, 2), ">u2")}, "mono8 or mono16"),
        (topics.FRAME, {"image": np.zeros((2, 2, 3), np.uint8)}, "height, width"),
        (topics.FRAME, {"sequence": -1}, "range"),
        (topics.FRAME, {"stamp_ns": 2**100}, "range"),
        (topics.DEPTH, {"depth": np.zeros((2, 2), np.uint8)}, "16UC1"),
        (topics.DEPTH, {"scale_mm": float("nan")}, "scale_mm"),
        (topics.CLOUD, {"grid_px": 0.0}, "grid_px"),
        (topics.CLOUD, {"points": np.zeros((2, 2), np.float32)}, "no fields"),
        (topics.CLOUD, {"points": np.zeros((0, 2), example(topics.CLOUD).points.dtype)}, "height, width"),
        (topics.MAP, {"removed": np.zeros((2, 3), np.int32)}, "int16"),
        (topics.MAP, {"points": np.zeros(2, [("key", "<i8")])}, "key"),
        (topics.MAP, {"points": np.zeros((2, 2), example(topics.MAP).points.dtype)}, r"\(n,\)"),
        (topics.POSE, {"T_world_camera": np.zeros((4, 4))}, "rotation"),
        (topics.POSE, {"T_world_camera": np.full((4, 4), np.nan)}, "rotation"),
        (topics.POSE, {"T_world_camera": np.diag([1.0, 1, -1, 1])}, "rotation"),
        (topics.POSE, {"T_world_camera": np.eye(3)}, r"\(4, 4\)"),
        (topics.POSE, {"information": np.eye(5)}, r"\(6, 6\)"),
        (topics.PART_POSE, {"T_part_camera": np.zeros((4, 4))}, "rotation"),
        (topics.PART_POSE, {"information": np.eye(5)}, r"\(6, 6\)"),
        (topics.PROJECTOR, {"dist": np.zeros(4)}, r"\(5,\)"),
    ],
)
def test_what_cannot_travel_is_refused(topic, change, says):
    with pytest.raises(ValueError, match=says):
        codec.encode(dataclasses.replace(example(topic), **change))
