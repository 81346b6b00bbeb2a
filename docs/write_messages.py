"""Writes docs/messages.md from the topics table, the messages and their descriptors.

`python docs/write_messages.py`; a test compares, so the page can't drift.
"""

from __future__ import annotations

import ast
import inspect
import math
from collections.abc import Iterator
from pathlib import Path

from endo3d.schemas import codec, messages, topics
from endo3d.schemas.protos import LABEL, message_class
from endo3d.schemas.topics import Topic
from endo3d.schemas.wire import PADDING

FOXGLOVE = {
    "stamp_ns": "timestamp",
    "image": "data",
    "points": "data",
    "depth": "data",
    "T_world_camera": "pose",
    "T_part_camera": "pose",
    "T_parent_child": "translation, rotation",
    "dist": "D",
    "service": "name",
}
"""Where our name and the protobuf field's differ."""

INTRODUCTION = f"""# Messages

Written by `docs/write_messages.py` from `schemas/`; a test compares the two.

Lengths are mm, angles rad, stamps ns of the rig's clock, unless a name says otherwise (`_um`, `_us`, `_px`,
`_hz`). `T_a_b` maps coordinates of frame b into frame a. What was not measured is NaN, never zero. Messages
only grow: fields are appended with a default, so old logs decode.

## Two ways to read them

With this package, from bytes of the bus or of a log alike; a large array is a read-only view of those bytes:

```python
from endo3d.schemas import codec, topics

frame = codec.decode(topics.FRAME, payload)  # endo3d.schemas.messages.Frame
frame.image, frame.slot, frame.stamp_ns
```

Without it, with any protobuf library in any language: what can be shown is one of Foxglove's messages. What
Foxglove's lack travels in the same message as field {LABEL}, `label`; field {PADDING} is padding that aligns
the array. Stock readers (Foxglove, Rerun, `foxglove-schemas-protobuf`) skip both. An MCAP log carries the
complete descriptors, so a reader that builds its classes from the log sees the labels as well (here with
`pip install mcap-protobuf-support`):

```python
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

reader = make_reader(open("scan.mcap", "rb"), decoder_factories=[DecoderFactory()])
for schema, channel, record, proto in reader.iter_decoded_messages(topics=["/frame"]):
    print(proto.width, proto.height, proto.label.slot)
```

The array of a bulk message stands last, at byte {codec.DATA_OFFSET}, written in place. Any other writer may
put it anywhere and leave the label out: it is read with slot -1, zero counts and NaN figures.

## Topics

The key on the bus is `endo3d/<rig>/<topic>`, and the channel in a log `/<topic>`; a topic marked "per
service" has the service's name appended to both.
"""


def _markdown(docstring: object) -> str:
    return " ".join(str(docstring).split()).replace("``", "`")


def _documented(message: type) -> Iterator[tuple[str, str, str]]:
    """Name, type and docstring of every field, as written in messages.py."""
    (tree,) = ast.parse(inspect.getsource(message)).body
    assert isinstance(tree, ast.ClassDef)
    for field, after in zip(tree.body, [*tree.body[1:], None], strict=True):
        if isinstance(field, ast.AnnAssign):
            text = ""
            if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
                text = _markdown(after.value.value)
            yield ast.unparse(field.target), ast.unparse(field.annotation), text


def _travels_as(topic: Topic, name: str) -> str:
    """The protobuf field, with the label's number where it is in the label."""
    fields = message_class(topic).DESCRIPTOR.fields_by_name
    label = fields["label"].message_type.fields_by_name if "label" in fields else {}
    if name in label:
        return f"`label.{name}` ({LABEL}.{label[name].number})"
    if name in fields:
        return f"`{name}` ({fields[name].number})"
    travelling = FOXGLOVE[name].split(", ")
    return ", ".join(f"`{field}` ({fields[field].number})" for field in travelling)


def _rate(rate_hz: float) -> str:
    return "all" if math.isinf(rate_hz) else f"{rate_hz:g} Hz"


def _row(*cells: str) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def page() -> str:
    """The whole page."""
    lines = [INTRODUCTION]
    lines.append(_row("topic", "message", "on the wire", "at most", "queue", "logged", "how"))
    lines.append(_row(*["---"] * 7))
    for topic in topics.TOPICS:
        marks = {"bulk": topic.bulk, "latched": topic.latched, "per service": topic.per_service}
        lines.append(
            _row(
                f"[`{topic.name}`](#{topic.name.replace('/', '')})",
                f"`{topic.message.__name__}`",
                f"`{codec.schema(topic).name}`",
                _rate(topic.rate_hz),
                str(topic.depth),
                _rate(topic.log_hz),
                ", ".join(name for name, holds in marks.items() if holds),
            )
        )
    for topic in topics.TOPICS:
        lines += [
            "",
            f"## {topic.name}",
            "",
            f"`messages.{topic.message.__name__}`. {_markdown(topic.message.__doc__)}",
            "",
        ]
        lines += [_row("field", "type", "travels as", ""), _row(*["---"] * 4)]
        for name, kind, text in _documented(topic.message):
            lines.append(_row(f"`{name}`", f"`{kind}`", _travels_as(topic, name), text))
    points = ", ".join(f"`{name}`" for name in messages.POINT.names or ())
    lines += ["", "## A point of a cloud", "", f"Six little-endian float32, 24 bytes: {points}.", ""]
    lines += ["Position and 1-sigma of z in mm, intensity in grey values, quality 0..1.", ""]
    return "\n".join(lines)


if __name__ == "__main__":
    Path(__file__).with_name("messages.md").write_text(page())
