"""ROS 2 message types: their definitions, and what follows from them (layout on the wire, hash of the type).

The definitions are those of ROS 2's common_interfaces, without comments and constants, which travel nowhere.
"""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass
from functools import cache
from typing import Any

DEFINITIONS = {
    "builtin_interfaces/msg/Time": "int32 sec; uint32 nanosec",
    "std_msgs/msg/Header": "builtin_interfaces/Time stamp; string frame_id",
    "sensor_msgs/msg/Image": "std_msgs/Header header; uint32 height; uint32 width; string encoding;"
    "uint8 is_bigendian; uint32 step; uint8[] data",
    "sensor_msgs/msg/PointField": "string name; uint32 offset; uint8 datatype; uint32 count",
    "sensor_msgs/msg/PointCloud2": "std_msgs/Header header; uint32 height; uint32 width;"
    "sensor_msgs/PointField[] fields; bool is_bigendian; uint32 point_step; uint32 row_step; uint8[] data;"
    "bool is_dense",
    "sensor_msgs/msg/RegionOfInterest": "uint32 x_offset; uint32 y_offset; uint32 height; uint32 width;bool do_rectify",
    "sensor_msgs/msg/CameraInfo": "std_msgs/Header header; uint32 height; uint32 width;"
    "string distortion_model; float64[] d; float64[9] k; float64[9] r; float64[12] p; uint32 binning_x;"
    "uint32 binning_y; sensor_msgs/RegionOfInterest roi",
    "geometry_msgs/msg/Point": "float64 x; float64 y; float64 z",
    "geometry_msgs/msg/Vector3": "float64 x; float64 y; float64 z",
    "geometry_msgs/msg/Quaternion": "float64 x 0; float64 y 0; float64 z 0; float64 w 1",
    "geometry_msgs/msg/Pose": "geometry_msgs/Point position; geometry_msgs/Quaternion orientation",
    "geometry_msgs/msg/PoseWithCovariance": "geometry_msgs/Pose pose; float64[36] covariance",
    "geometry_msgs/msg/Twist": "geometry_msgs/Vector3 linear; geometry_msgs/Vector3 angular",
    "geometry_msgs/msg/TwistWithCovariance": "geometry_msgs/Twist twist; float64[36] covariance",
    "geometry_msgs/msg/Transform": "geometry_msgs/Vector3 translation; geometry_msgs/Quaternion rotation",
    "geometry_msgs/msg/TransformStamped": "std_msgs/Header header; string child_frame_id;"
    "geometry_msgs/Transform transform",
    "nav_msgs/msg/Odometry": "std_msgs/Header header; string child_frame_id;"
    "geometry_msgs/PoseWithCovariance pose; geometry_msgs/TwistWithCovariance twist",
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms",
}

PRIMITIVES = {
    "uint8": ("<u1", 3),
    "int32": ("<i4", 6),
    "uint32": ("<u4", 7),
    "float64": ("<f8", 11),
    "bool": ("<u1", 15),
}
"""Name: (numpy type on the wire, type number of the type description)."""
STRING, NESTED, ARRAY, UNBOUNDED = 17, 1, 48, 144
"""Type numbers of type_description_interfaces/msg/FieldType; the last two are added to the element's."""

_FIELD = re.compile(r"(?P<type>[\w/]+)(?:\[(?P<count>\d*)\])?\s+(?P<name>\w+)(?:\s+(?P<default>\S+))?")


@dataclass(frozen=True)
class Field:
    """One member of a message."""

    name: str
    type: str
    """A primitive, ``string``, or a full type name."""
    count: int | None
    """None: a single one; 0: a sequence; n: an array of n."""
    default: str


@cache
def fields(name: str) -> tuple[Field, ...]:
    """The members of a type, in order."""
    found = []
    for text in DEFINITIONS[name].split(";"):
        match = _FIELD.fullmatch(text.strip())
        if match is None:
            raise ValueError(f"not a field: {text}")
        kind = match["type"].replace("/", "/msg/")
        count = None if match["count"] is None else int(match["count"] or 0)
        found.append(Field(match["name"], kind, count, match["default"] or ""))
    return tuple(found)


@cache
def nested(name: str) -> tuple[str, ...]:
    """All types that a type is made of, without itself, sorted."""
    direct = {field.type for field in fields(name) if field.type in DEFINITIONS}
    return tuple(sorted(direct.union(*map(nested, direct))))


def text(name: str) -> str:
    """The definition as MCAP's encoding ``ros2msg`` wants it: the type, then every type it is made of."""
    parts = [_lines(name)]
    for part in nested(name):
        parts.append("=" * 80 + f"\nMSG: {part.replace('/msg/', '/')}\n" + _lines(part))
    return "".join(parts)


def _lines(name: str) -> str:
    lines = []
    for field in fields(name):
        brackets = "" if field.count is None else f"[{field.count or ''}]"
        default = f" {field.default}" if field.default else ""
        lines.append(f"{field.type.replace('/msg/', '/')}{brackets} {field.name}{default}\n")
    return "".join(lines)


@cache
def type_hash(name: str) -> str:
    """``RIHS01_...``: SHA-256 of the type's description as JSON (REP 2016)."""
    description = {
        "type_description": _description(name),
        "referenced_type_descriptions": [_description(part) for part in nested(name)],
    }
    return "RIHS01_" + hashlib.sha256(json.dumps(description).encode()).hexdigest()


def _description(name: str) -> dict[str, Any]:
    described = []
    for field in fields(name):
        number = STRING if field.type == "string" else PRIMITIVES.get(field.type, ("", NESTED))[1]
        if field.count is not None:
            number += ARRAY if field.count else UNBOUNDED
        kind = {
            "type_id": number,
            "capacity": field.count or 0,
            "string_capacity": 0,
            "nested_type_name": field.type if field.type in DEFINITIONS else "",
        }
        described.append({"name": field.name, "type": kind})
    return {"type_name": name, "fields": described}
