"""The protobuf classes of every topic: Foxglove's messages with our companion as field 100, or our own.

Foxglove's file descriptors get two fields appended and are built again in a private pool per topic. So the
stock classes stay untouched, the name stays ``foxglove.RawImage``, and stock readers skip what they don't
know.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from foxglove_schemas_protobuf import (
    CameraCalibration_pb2,
    FrameTransform_pb2,
    Log_pb2,
    PointCloud_pb2,
    PoseInFrame_pb2,
    RawImage_pb2,
)
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

from endo3d.schemas import endo3d_pb2, topics
from endo3d.schemas.topics import Topic
from endo3d.schemas.wire import PADDING

LABEL = 100
"""Number of the companion's field."""


class Schema(NamedTuple):
    """What an archive needs to know about a channel."""

    name: str
    encoding: str
    """``protobuf``."""
    data: bytes
    """A serialised ``FileDescriptorSet``: the message's file after everything it imports."""


_SOURCES: dict[Topic, tuple[FileDescriptor, str, str | None]] = {
    topics.FRAME: (RawImage_pb2.DESCRIPTOR, "foxglove.RawImage", "endo3d.FrameLabel"),
    topics.CLOUD: (PointCloud_pb2.DESCRIPTOR, "foxglove.PointCloud", "endo3d.CloudLabel"),
    topics.DEPTH: (RawImage_pb2.DESCRIPTOR, "foxglove.RawImage", "endo3d.DepthLabel"),
    topics.POSE: (PoseInFrame_pb2.DESCRIPTOR, "foxglove.PoseInFrame", "endo3d.PoseHealth"),
    topics.PART_POSE: (PoseInFrame_pb2.DESCRIPTOR, "foxglove.PoseInFrame", "endo3d.PartHealth"),
    topics.TRANSFORM: (FrameTransform_pb2.DESCRIPTOR, "foxglove.FrameTransform", None),
    topics.MAP: (PointCloud_pb2.DESCRIPTOR, "foxglove.PointCloud", "endo3d.MapLabel"),
    topics.MODE: (endo3d_pb2.DESCRIPTOR, "endo3d.Mode", None),
    topics.CAMERA: (CameraCalibration_pb2.DESCRIPTOR, "foxglove.CameraCalibration", None),
    topics.PROJECTOR: (CameraCalibration_pb2.DESCRIPTOR, "foxglove.CameraCalibration", "endo3d.RigLabel"),
    topics.TRUTH: (endo3d_pb2.DESCRIPTOR, "endo3d.Truth", None),
    topics.STATUS: (endo3d_pb2.DESCRIPTOR, "endo3d.Status", None),
    topics.LOG: (Log_pb2.DESCRIPTOR, "foxglove.Log", None),
}


def _files(file: FileDescriptor, found: dict[str, FileDescriptorProto]) -> dict[str, FileDescriptorProto]:
    """``file`` after everything it imports, by name."""
    for needed in file.dependencies:
        _files(needed, found)
    if file.name not in found:
        found[file.name] = FileDescriptorProto()
        file.CopyToProto(found[file.name])
    return found


def _extend(file: FileDescriptorProto, name: str, label: str) -> None:
    """Append ``label`` and ``padding`` to the message ``name`` of ``file``."""
    (message,) = (m for m in file.message_type if f"{file.package}.{m.name}" == name)
    file.dependency.append(endo3d_pb2.DESCRIPTOR.name)
    optional = FieldDescriptorProto.LABEL_OPTIONAL
    message.field.add(
        name="label",
        number=LABEL,
        label=optional,
        type=FieldDescriptorProto.TYPE_MESSAGE,
        type_name=f".{label}",
    )
    message.field.add(name="padding", number=PADDING, label=optional, type=FieldDescriptorProto.TYPE_BYTES)


def _build(file: FileDescriptor, name: str, label: str | None) -> tuple[Schema, type[Any]]:
    found = _files(file, {} if label is None else _files(endo3d_pb2.DESCRIPTOR, {}))
    if label is not None:
        _extend(found[file.name], name, label)
    pool = DescriptorPool()
    for one in found.values():
        pool.Add(one)
    data = FileDescriptorSet(file=found.values()).SerializeToString(deterministic=True)
    return Schema(name, "protobuf", data), GetMessageClass(pool.FindMessageTypeByName(name))


_BUILT = {topic.name: _build(*source) for topic, source in _SOURCES.items()}


def schema(topic: Topic) -> Schema:
    """Name, encoding and descriptors of a topic's messages, as MCAP stores them."""
    return _BUILT[topic.name][0]


def message_class(topic: Topic) -> type[Any]:
    """The protobuf class of a topic, with ``label`` and ``padding`` where it has them."""
    return _BUILT[topic.name][1]
