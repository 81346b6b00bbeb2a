"""Messages to bytes and back; the large array stays where it is.

A message with a large array has it last, at ``DATA_OFFSET``, so that shared memory can lend the array before
its message exists:

    slot = ...                                   # DATA_OFFSET + 1920 * 1200 bytes of shared memory
    image = slot[DATA_OFFSET:].reshape(1200, 1920)
    ...                                          # the camera writes the image
    encode_into(Frame(..., image=image), slot)   # the header goes in front of it
    decode(topics.FRAME, slot).image             # a read-only view of the same memory

Foreign writers may put the array anywhere and leave our label out: ``decode`` reads them as well.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from endo3d.schemas import array_messages as arrays
from endo3d.schemas import small_messages as small
from endo3d.schemas import topics
from endo3d.schemas.messages import Message
from endo3d.schemas.protos import message_class, schema
from endo3d.schemas.topics import Topic
from endo3d.schemas.wire import Malformed, field_front, front, room, span

__all__ = [
    "DATA_OFFSET",
    "Malformed",
    "array_of",
    "data_span",
    "decode",
    "encode",
    "encode_into",
    "encoded_size",
    "schema",
]

DATA_OFFSET = 1024
"""Where the array of a bulk message starts: 64-byte aligned, with room for the header of any bulk message."""
ALIGNMENT = 64
DATA = 6
"""Number of the field ``data``, in foxglove.RawImage and in foxglove.PointCloud."""

Buffer = memoryview | bytes | bytearray | NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class _Way:
    """How the messages of one topic cross."""

    topic: Topic
    fill: Callable[[Any, Any], None]
    """Writes everything but the large array into an empty protobuf message."""
    read: Callable[..., Message]
    """Takes the protobuf message, and the array's bytes if there is an array."""
    array: str = ""
    """The large array's name."""


_WAYS = {
    way.topic.name: way
    for way in (
        _Way(topics.FRAME, arrays.fill_frame, arrays.read_frame, "image"),
        _Way(topics.CLOUD, arrays.fill_cloud, arrays.read_cloud, "points"),
        _Way(topics.DEPTH, arrays.fill_depth, arrays.read_depth, "depth"),
        _Way(topics.MAP, arrays.fill_map, arrays.read_map, "points"),
        _Way(topics.POSE, small.fill_pose, small.read_pose),
        _Way(topics.PART_POSE, small.fill_part_pose, small.read_part_pose),
        _Way(topics.TRANSFORM, small.fill_frame_transform, small.read_frame_transform),
        _Way(topics.MODE, small.fill_mode, small.read_mode),
        _Way(topics.CAMERA, small.fill_camera, small.read_camera),
        _Way(topics.PROJECTOR, small.fill_projector, small.read_projector),
        _Way(topics.TRUTH, small.fill_truth, small.read_truth),
        _Way(topics.STATUS, small.fill_status, small.read_status),
        _Way(topics.LOG, small.fill_log, small.read_log),
    )
}


def array_of(message: Message) -> NDArray[Any] | None:
    """The large array of a bulk message, None of any other."""
    topic = topics.of(message)
    return getattr(message, _WAYS[topic.name].array) if topic.bulk else None


def encoded_size(message: Message) -> int:
    """Bytes that ``encode_into`` needs for a bulk message."""
    return DATA_OFFSET + _bulk_array(message).nbytes


def encode_into(message: Message, buffer: Buffer) -> int:
    """Write a bulk message to the start of ``buffer``; returns ``encoded_size(message)``.

    The array is copied to ``DATA_OFFSET`` unless that is where it already stands. Raises ``ValueError`` for a
    buffer that is too small or a header that is too long.
    """
    array = _bulk_array(message)
    size = DATA_OFFSET + array.nbytes
    sample = np.frombuffer(buffer, np.uint8)
    if len(sample) < size:
        raise ValueError(f"{size} bytes don't fit into {len(sample)}")
    header = _serialise(_WAYS[topics.of(message).name], message)
    before = front(header, DATA, array.nbytes, DATA_OFFSET)
    if not _starts_at(array, sample[DATA_OFFSET:]):
        np.ndarray(array.shape, array.dtype, sample, DATA_OFFSET)[...] = array
    sample.data[:DATA_OFFSET] = before
    return size


def encode(message: Message) -> bytes:
    """The message as bytes; the array is copied once.

    Equal messages give equal bytes. Raises ``ValueError`` or ``TypeError`` for values that don't fit.
    """
    way = _WAYS[topics.of(message).name]
    header = _serialise(way, message)
    if not way.array:
        return header
    array = np.ascontiguousarray(getattr(message, way.array))
    # A map's header grows with the keys it removes; a bulk message's always fits.
    offset = DATA_OFFSET if way.topic.bulk else room(header, DATA, array.nbytes, ALIGNMENT)
    return b"".join((front(header, DATA, array.nbytes, offset), array.reshape(-1).view(np.uint8).data))


def data_span(buffer: Buffer) -> tuple[int, int]:
    """Where the array of an encoded message with one starts and ends. Raises ``Malformed``."""
    _, start, stop = span(_view(buffer), DATA)
    return start, stop


def decode(topic: Topic, buffer: Buffer) -> Message:
    """The message in ``buffer``; its large array is a read-only view that keeps the buffer alive.

    Raises ``Malformed``, and nothing else, for bytes that are not such a message.
    """
    way = _WAYS[topic.name]
    view = _view(buffer)
    try:
        if not way.array:
            return way.read(_parse(topic, bytes(view)))
        return way.read(*(_split_ours(topic, view) or _split(topic, view)))
    except Malformed as error:
        raise Malformed(f"{topic.name}: {error}") from None


def _view(buffer: Buffer) -> memoryview:
    """Read-only bytes. (For mypy an ndarray is a buffer only from Python 3.12 on.)"""
    return memoryview(buffer).toreadonly().cast("B")  # type: ignore[arg-type]


def _split_ours(topic: Topic, view: memoryview) -> tuple[Any, memoryview] | None:
    """Header and array of a message whose last field is ``data`` at ``DATA_OFFSET``; None for any other.

    Bytes that parse as fields, followed by one field, are those fields: nothing has to be scanned.
    """
    last = field_front(DATA, max(0, len(view) - DATA_OFFSET))
    start = DATA_OFFSET - len(last)
    if view[start:DATA_OFFSET] != last:
        return None
    try:
        return _parse(topic, bytes(view[:start])), view[DATA_OFFSET:]
    except Malformed:
        return None


def _split(topic: Topic, view: memoryview) -> tuple[Any, memoryview]:
    """Header and array, wherever ``data`` stands."""
    field, start, stop = span(view, DATA)
    return _parse(topic, bytes(view[:field]) + bytes(view[stop:])), view[start:stop]


def _bulk_array(message: Message) -> NDArray[Any]:
    array = array_of(message)
    if array is None:
        raise ValueError(f"a {type(message).__name__} is not bulk: encode() it")
    return array


def _starts_at(array: NDArray[Any], place: NDArray[np.uint8]) -> bool:
    """Is ``array`` contiguous, its first byte that of ``place``? (numpy takes 6 us to tell two addresses.)"""
    return array.flags.c_contiguous and np.may_share_memory(array.reshape(-1).view(np.uint8)[:1], place[:1])


def _serialise(way: _Way, message: Message) -> bytes:
    proto = message_class(way.topic)()
    way.fill(proto, message)
    serialised: bytes = proto.SerializeToString(deterministic=True)
    return serialised


def _parse(topic: Topic, header: bytes) -> Any:
    try:
        return message_class(topic).FromString(header)
    except DecodeError as error:
        raise Malformed(f"not a {schema(topic).name}: {error}") from error
