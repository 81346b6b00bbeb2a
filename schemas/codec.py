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
Fill = Callable[[Any, Any], None]

_WITH_ARRAY: dict[Topic, tuple[str, Fill, Callable[[Any, memoryview], Message]]] = {
    topics.FRAME: ("image", arrays.fill_frame, arrays.read_frame),
    topics.CLOUD: ("points", arrays.fill_cloud, arrays.read_cloud),
    topics.DEPTH: ("depth", arrays.fill_depth, arrays.read_depth),
    topics.MAP: ("points", arrays.fill_map, arrays.read_map),
}
"""The large array's name, and the two ways across."""
_SMALL: dict[Topic, tuple[Fill, Callable[[Any], Message]]] = {
    topics.POSE: (small.fill_pose, small.read_pose),
    topics.TRANSFORM: (small.fill_frame_transform, small.read_frame_transform),
    topics.MODE: (small.fill_mode, small.read_mode),
    topics.CAMERA: (small.fill_camera, small.read_camera),
    topics.PROJECTOR: (small.fill_projector, small.read_projector),
    topics.TRUTH: (small.fill_truth, small.read_truth),
    topics.STATUS: (small.fill_status, small.read_status),
    topics.LOG: (small.fill_log, small.read_log),
}


def array_of(message: Message) -> NDArray[Any] | None:
    """The large array of a bulk message, None of any other."""
    topic = topics.of(message)
    return _array(topic, message) if topic.bulk else None


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
    sample = np.frombuffer(buffer, np.uint8)[:size]
    if len(sample) < size:
        raise ValueError(f"{size} bytes don't fit into {len(sample)}")
    front_bytes = front(_serialise(topics.of(message), message), DATA, array.nbytes, DATA_OFFSET)
    place = sample[DATA_OFFSET:].view(array.dtype).reshape(array.shape)
    if _address(place) != _address(array) or not array.flags.c_contiguous:
        place[...] = array
    sample[:DATA_OFFSET] = np.frombuffer(front_bytes, np.uint8)
    return size


def encode(message: Message) -> bytes:
    """The message as bytes; the array is copied once.

    Equal messages give equal bytes. Raises ``ValueError`` or ``TypeError`` for values that don't fit.
    """
    topic = topics.of(message)
    header = _serialise(topic, message)
    if topic not in _WITH_ARRAY:
        return header
    array = np.ascontiguousarray(_array(topic, message))
    # A map's header grows with the keys it removes; a bulk message's always fits.
    offset = DATA_OFFSET if topic.bulk else room(header, DATA, array.nbytes, ALIGNMENT)
    return front(header, DATA, array.nbytes, offset) + array.tobytes()


def data_span(buffer: Buffer) -> tuple[int, int]:
    """Where the array of an encoded message with one starts and ends. Raises ``Malformed``."""
    return span(memoryview(buffer).cast("B"), DATA)[1:]


def decode(topic: Topic, buffer: Buffer) -> Message:
    """The message in ``buffer``; its large array is a read-only view that keeps the buffer alive.

    Raises ``Malformed``, and nothing else, for bytes that are not such a message.
    """
    view = memoryview(buffer).toreadonly().cast("B")
    try:
        if topic not in _WITH_ARRAY:
            return _SMALL[topic][1](_parse(topic, bytes(view)))
        read = _WITH_ARRAY[topic][2]
        return read(*(_split_ours(topic, view) or _split(topic, view)))
    except Malformed as error:
        raise Malformed(f"{topic.name}: {error}") from None


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


def _array(topic: Topic, message: Message) -> NDArray[Any]:
    array: NDArray[Any] = getattr(message, _WITH_ARRAY[topic][0])
    return array


def _bulk_array(message: Message) -> NDArray[Any]:
    array = array_of(message)
    if array is None:
        raise ValueError(f"a {type(message).__name__} is not bulk: encode() it")
    return array


def _address(array: NDArray[Any]) -> int:
    address: int = array.__array_interface__["data"][0]
    return address


def _serialise(topic: Topic, message: Message) -> bytes:
    proto = message_class(topic)()
    fill = _WITH_ARRAY[topic][1] if topic in _WITH_ARRAY else _SMALL[topic][0]
    fill(proto, message)
    serialised: bytes = proto.SerializeToString(deterministic=True)
    return serialised


def _parse(topic: Topic, header: bytes) -> Any:
    try:
        return message_class(topic).FromString(header)
    except DecodeError as error:
        raise Malformed(f"not a {schema(topic).name}: {error}") from error
