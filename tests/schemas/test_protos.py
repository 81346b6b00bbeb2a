"""The descriptors: Foxglove's with our fields, private to us, complete, changed only by appending."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from any_message import example
from foxglove_schemas_protobuf import PointCloud_pb2, RawImage_pb2
from google.protobuf import descriptor_pool
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from google.protobuf.message_factory import GetMessages

from endo3d.schemas import codec, endo3d_pb2, topics
from endo3d.schemas.protos import LABEL, message_class
from endo3d.schemas.wire import PADDING

every_topic = pytest.mark.parametrize("topic", topics.TOPICS, ids=lambda topic: topic.name)
SCHEMAS = Path(endo3d_pb2.__file__).parent


def stranger(topic):
    """The class that a reader builds who has nothing but the archive's schema."""
    schema = codec.schema(topic)
    assert schema.encoding == "protobuf"
    files = FileDescriptorSet.FromString(schema.data).file
    return GetMessages(list(files))[schema.name]


@every_topic
def test_a_stranger_reads_everything(topic):
    message = example(topic)
    proto = stranger(topic).FromString(codec.encode(message))
    assert proto.timestamp.seconds * 10**9 + proto.timestamp.nanos == message.stamp_ns
    proto.DiscardUnknownFields()
    assert proto.SerializeToString(deterministic=True) == message_class(topic).FromString(
        codec.encode(message)
    ).SerializeToString(deterministic=True)


def test_a_stranger_reads_the_labels():
    frame = stranger(topics.FRAME).FromString(codec.encode(example(topics.FRAME)))
    assert (frame.label.pattern_set, frame.label.slot, frame.label.sequence) == ("interleaved f1=25", 7, 41)
    pose = stranger(topics.POSE).FromString(codec.encode(example(topics.POSE)))
    assert pose.label.Tracking.Name(pose.label.state) == "DEGENERATE"
    np.testing.assert_array_equal(
        np.reshape(pose.label.information, (6, 6)), example(topics.POSE).information
    )


@every_topic
def test_a_schemas_files_come_after_what_they_import(topic):
    seen = set()
    for file in FileDescriptorSet.FromString(codec.schema(topic).data).file:
        assert set(file.dependency) <= seen
        assert file.name not in seen
        seen.add(file.name)


def test_labels_can_be_read_out_of_a_stock_message():
    """Foxglove's package, endo3d_pb2 and nothing of ours at run time."""
    raw = codec.encode(example(topics.FRAME))
    stock = RawImage_pb2.RawImage.FromString(raw)
    assert stock.encoding == "mono8"
    label = endo3d_pb2.FrameLabel()
    label.ParseFromString(message_class(topics.FRAME).FromString(raw).label.SerializeToString())
    assert label.epoch == 3


def test_foxgloves_own_classes_are_untouched():
    for file, name in ((RawImage_pb2, "RawImage"), (PointCloud_pb2, "PointCloud")):
        assert LABEL not in file.DESCRIPTOR.message_types_by_name[name].fields_by_number
        assert (
            descriptor_pool.Default().FindMessageTypeByName(f"foxglove.{name}")
            is getattr(file, name).DESCRIPTOR
        )
    for topic in topics.TOPICS:
        descriptor = message_class(topic).DESCRIPTOR
        if descriptor.full_name.startswith("foxglove.") and "label" in descriptor.fields_by_name:
            assert descriptor.fields_by_name["label"].number == LABEL
            assert descriptor.fields_by_name["padding"].number == PADDING


def numbers(file):
    """(message, number) -> (name, type, repeated) of every field, and (enum, number) -> name."""
    found = {}

    def visit(prefix, message):
        for field in message.field:
            found[f"{prefix}{message.name}", field.number] = (
                field.name,
                field.type,
                field.label,
                field.type_name,
            )
        for enum in message.enum_type:
            for value in enum.value:
                found[f"{prefix}{message.name}.{enum.name}", value.number] = value.name
        for nested in message.nested_type:
            visit(f"{prefix}{message.name}.", nested)

    for message in file.message_type:
        visit("", message)
    return found


def generated():
    file = FileDescriptorProto()
    endo3d_pb2.DESCRIPTOR.CopyToProto(file)
    return file


def test_the_first_release_is_still_there():
    """Fields are only appended: every number of v0 keeps its name and type."""
    released = FileDescriptorSet.FromString((Path(__file__).parent / "logs" / "v0.desc").read_bytes()).file
    (ours,) = (file for file in released if file.name == "endo3d.proto")
    now = numbers(generated())
    assert {key: now.get(key) for key in numbers(ours)} == numbers(ours)


def test_the_generated_code_runs_with_the_oldest_protobuf_we_allow():
    (demanded,) = re.findall(r"Protobuf Python Version: (\d+)\.(\d+)", Path(endo3d_pb2.__file__).read_text())
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    (needed,) = (need for need in project["dependencies"] if need.startswith("protobuf"))
    allowed = re.search(r">=(\d+)\.(\d+)", needed)
    assert allowed is not None
    assert tuple(map(int, demanded)) <= tuple(map(int, allowed.groups()))


@pytest.mark.skipif(importlib.util.find_spec("grpc_tools") is None, reason="grpcio-tools is not installed")
def test_the_generated_code_is_the_protos(tmp_path):
    """Compared as descriptors: the text of the generated file differs between versions of protoc."""
    out = tmp_path / "endo3d.desc"
    command = [sys.executable, "-W", "ignore", "-m", "grpc_tools.protoc", f"-I{SCHEMAS}"]
    subprocess.run([*command, f"--descriptor_set_out={out}", "endo3d.proto"], check=True)
    (compiled,) = FileDescriptorSet.FromString(out.read_bytes()).file
    expected = generated()
    for file in (compiled, expected):
        for message in file.message_type:
            for field in message.field:
                field.ClearField("json_name")
            for nested in message.nested_type:
                for field in nested.field:
                    field.ClearField("json_name")
    assert compiled == expected
