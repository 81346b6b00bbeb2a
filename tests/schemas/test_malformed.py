"""Whatever the bytes are: a message, or ``Malformed`` with one clear line, and soon."""

from __future__ import annotations

import dataclasses
import time

import numpy as np
import pytest
from any_message import example
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import DecodeError
from hypothesis import given, settings
from hypothesis import strategies as st

from endo3d.schemas import codec, topics
from endo3d.schemas.protos import message_class

every_topic = pytest.mark.parametrize("topic", topics.TOPICS, ids=lambda topic: topic.name)
ENCODED = {topic: codec.encode(example(topic)) for topic in topics.TOPICS}


def judged(topic, raw):
    """The message or None; anything but ``Malformed`` comes through."""
    try:
        message = codec.decode(topic, raw)
    except codec.Malformed as error:
        says = str(error)
    else:
        assert isinstance(message, topic.message)
        return message
    assert says.startswith(f"{topic.name}: ")
    assert "\n" not in says
    return None


def header_length(raw):
    """Bytes before the padding: where mutations hurt."""
    return raw.find(b"\xaa\x06") if b"\xaa\x06" in raw else len(raw)


@st.composite
def mutated(draw, raw):
    """Bytes changed, cut out, doubled or inserted, mostly in the header."""
    out = bytearray(raw)
    near = st.integers(0, header_length(raw))
    anywhere = st.integers(0, len(raw))
    for _ in range(draw(st.integers(1, 4))):
        at = min(draw(st.one_of(near, near, anywhere)), len(out))
        match draw(st.integers(0, 4)):
            case 0:
                out[at : at + 1] = draw(st.binary(min_size=1, max_size=1))
            case 1:
                del out[at : at + draw(st.integers(1, 40))]
            case 2:
                out[at:at] = draw(st.binary(max_size=12))
            case 3:
                out[at:at] = out[at : at + draw(st.integers(1, 40))]
            case 4:
                out[at:at] = b"\xff" * draw(st.integers(1, 11))
    return bytes(out)


@every_topic
@settings(max_examples=150)
@given(st.data())
def test_mutated_bytes_do_no_harm(topic, data):
    judged(topic, data.draw(mutated(ENCODED[topic])))


@every_topic
@given(st.binary(max_size=300))
def test_random_bytes_do_no_harm(topic, raw):
    judged(topic, raw)


@every_topic
@given(st.data())
def test_senseless_values_do_no_harm(topic, data):
    """Well-formed protobuf that says nonsense: every check behind the parser."""
    proto = message_class(topic).FromString(ENCODED[topic])
    for message in (proto, proto.label) if "label" in proto.DESCRIPTOR.fields_by_name else (proto,):
        plain = [f for f in message.DESCRIPTOR.fields if f.message_type is None and not f.is_repeated]
        for field in data.draw(st.lists(st.sampled_from(plain), max_size=3)) if plain else ():
            setattr(message, field.name, data.draw(SENSELESS[field.type]))
    judged(topic, proto.SerializeToString())


_SIGNED = st.sampled_from([0, 1, 4, 2**31 - 1, -1])
_UNSIGNED = st.sampled_from([0, 1, 2, 3, 4, 5, 6, 2**32 - 1])
SENSELESS = {
    FieldDescriptor.TYPE_BOOL: st.booleans(),
    FieldDescriptor.TYPE_BYTES: st.integers(0, 200).map(bytes),
    FieldDescriptor.TYPE_DOUBLE: st.floats(),
    FieldDescriptor.TYPE_ENUM: st.sampled_from([0, 1, 5, 77]),
    FieldDescriptor.TYPE_FIXED32: _UNSIGNED,
    FieldDescriptor.TYPE_INT32: _SIGNED,
    FieldDescriptor.TYPE_INT64: _SIGNED,
    FieldDescriptor.TYPE_SINT32: _SIGNED,
    FieldDescriptor.TYPE_STRING: st.sampled_from(["", "mono8", "mono16", "16UC1", "rgb8", "plumb_bob"]),
    FieldDescriptor.TYPE_UINT32: _UNSIGNED,
    FieldDescriptor.TYPE_UINT64: _UNSIGNED,
}


@every_topic
def test_every_beginning_does_no_harm(topic):
    raw = ENCODED[topic]
    for stop in [*range(min(len(raw), 400)), *range(900, len(raw), 7)]:
        judged(topic, raw[:stop])


@every_topic
@given(st.data())
def test_nothing_is_accepted_that_the_library_refuses(topic, data):
    raw = data.draw(mutated(ENCODED[topic]))
    if judged(topic, raw) is None:
        return
    try:
        message_class(topic).FromString(raw)
    except DecodeError as error:
        raise AssertionError("decoded what is not a message") from error


@pytest.mark.parametrize("one", topics.TOPICS, ids=lambda topic: topic.name)
@pytest.mark.parametrize("other", topics.TOPICS, ids=lambda topic: topic.name)
def test_another_topics_bytes_do_no_harm(one, other):
    judged(one, ENCODED[other])


def changed(topic, change):
    """An example's bytes after ``change(proto)``."""
    proto = message_class(topic).FromString(ENCODED[topic])
    change(proto)
    return proto.SerializeToString()


def assign(path, value):
    *parents, last = path.split(".")

    def change(proto):
        for parent in parents:
            proto = getattr(proto, parent)
        setattr(proto, last, value)

    return change


@pytest.mark.parametrize(
    ("topic", "change", "says"),
    [
        (topics.FRAME, assign("encoding", "rgb8"), "encoding is 'rgb8'"),
        (topics.FRAME, assign("step", 5), "rows of 5 bytes"),
        (topics.FRAME, assign("width", 7), "for 7 mono8 pixels"),
        (topics.FRAME, assign("height", 5), "5 rows"),
        (topics.FRAME, assign("height", 2**32 - 1), "rows"),
        (topics.FRAME, assign("width", 0), "for 0 mono8 pixels"),
        (topics.FRAME, assign("data", b""), "in 0 bytes"),
        (topics.FRAME, lambda proto: proto.ClearField("encoding"), "encoding is ''"),
        (topics.FRAME, assign("timestamp.nanos", -1), "out of range"),
        (topics.FRAME, assign("timestamp.seconds", 2**62), "out of range"),
        (topics.DEPTH, assign("encoding", "mono8"), "rows|16UC1"),
        (topics.DEPTH, assign("label.scale_mm", float("nan")), "scale_mm is nan"),
        (topics.DEPTH, assign("label.scale_mm", 0.0), "scale_mm is 0"),
        (topics.DEPTH, assign("label.offset_mm", float("inf")), "offset_mm is inf"),
        (topics.DEPTH, assign("label.grid_px", -1.0), "grid_px is -1"),
        (topics.CLOUD, assign("label.grid_px", float("nan")), "grid_px is nan"),
        (topics.CLOUD, assign("label.width", 4), r"\(3, 4\) points"),
        (topics.CLOUD, assign("label.height", 2**32 - 1), "points"),
        (topics.CLOUD, assign("label.height", 0), r"cloud of \(0, 5\)"),
        (topics.CLOUD, assign("point_stride", 20), "ends after"),
        (topics.CLOUD, assign("point_stride", 2**32 - 1), "layout|points"),
        (topics.CLOUD, lambda proto: proto.ClearField("fields"), "no fields"),
        (topics.CLOUD, lambda proto: assign("name", "y")(proto.fields[0]), "layout"),
        (topics.CLOUD, lambda proto: assign("name", "u")(proto.fields[0]), "without x, y and z"),
        (topics.CLOUD, lambda proto: assign("type", 0)(proto.fields[0]), "unknown type 0"),
        (topics.CLOUD, lambda proto: assign("offset", 2**32 - 1)(proto.fields[0]), "ends after"),
        (topics.MAP, assign("label.removed", b"12345"), "5 bytes of removed keys"),
        (topics.MAP, assign("data", bytes(100)), "points"),
        (topics.MAP, assign("label.merging_distance_mm", float("inf")), "merging_distance_mm is inf"),
        (topics.POSE, assign("label.state", 9), "tracking state 9"),
        (topics.POSE, assign("pose.orientation.x", float("nan")), "not a rotation"),
        (topics.POSE, lambda proto: proto.label.information.pop(), "information has 35"),
        (topics.PART_POSE, assign("label.state", 9), "fit 9"),
        (topics.POSE, lambda proto: proto.label.weak_direction.append(0), "weak_direction has 7"),
        (topics.TRANSFORM, lambda proto: proto.rotation.Clear(), "not a rotation"),
        (topics.CAMERA, assign("distortion_model", "kannala_brandt"), "kannala_brandt"),
        (topics.CAMERA, lambda proto: proto.K.pop(), "K has 8"),
        (topics.CAMERA, lambda proto: proto.D.append(0), "6 coefficients"),
        (topics.CAMERA, lambda proto: proto.K.__setitem__(0, float("nan")), "not finite"),
        (topics.PROJECTOR, lambda proto: proto.ClearField("label"), "T_projector_camera has 0"),
        (topics.TRUTH, lambda proto: proto.ClearField("T_scene_camera"), "T_scene_camera has 0"),
        (topics.STATUS, assign("state", 0), "service state 0"),
        (topics.LOG, assign("level", 77), "log level 77"),
    ],
)
def test_it_says_what_is_wrong(topic, change, says):
    with pytest.raises(codec.Malformed, match=says):
        codec.decode(topic, changed(topic, change))


@every_topic
def test_a_wrong_utf8_text_is_malformed(topic):
    raw = ENCODED[topic].replace(b"camera", b"\xff\xfemera").replace(b"decoder", b"\xff\xfecoder")
    raw = raw.replace(b"interleaved", b"\xff\xfeterleaved").replace(b"contour", b"\xff\xfentour")
    raw = raw.replace(b"world", b"\xff\xferld").replace(b"projector", b"\xff\xfeojector")
    raw = raw.replace(b"part", b"\xff\xfert")
    assert raw != ENCODED[topic]
    with pytest.raises(codec.Malformed, match="not a "):
        codec.decode(topic, raw)


def test_nothing_at_all_is_malformed_where_something_is_needed():
    for topic in (topics.FRAME, topics.CLOUD, topics.DEPTH, topics.MAP, topics.CAMERA, topics.STATUS):
        with pytest.raises(codec.Malformed):
            codec.decode(topic, b"")


@pytest.mark.parametrize("topic", [topics.FRAME, topics.CLOUD, topics.LOG], ids=lambda topic: topic.name)
def test_megabytes_of_nonsense_cost_no_time(topic):
    large = dataclasses.replace(example(topics.FRAME), image=np.zeros((1200, 1920), np.uint8))
    floods = [b"\x08\x01" * 1_150_000, b"\x22\x00" * 1_150_000, codec.encode(large)[1:], b"\xff" * 2_300_000]
    started = time.process_time()
    for flood in floods:
        judged(topic, flood)
    assert time.process_time() - started < 1.0
