"""``endo3d tap``: a stream, printed as it passes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from endo3d.services.cli.options import JsonOption, RigOption

if TYPE_CHECKING:
    from endo3d.schemas.messages import Message
    from endo3d.schemas.topics import Topic

SMALL = 64
"""Arrays up to this many elements are printed, larger ones are described."""


def complete_key(incomplete: str) -> list[str]:
    from endo3d.schemas.topics import BY_NAME

    return [name for name in BY_NAME if name.startswith(incomplete)]


def tap(
    key: Annotated[
        str, typer.Argument(help="A topic (pose) or a key (endo3d/demo/pose).", autocompletion=complete_key)
    ],
    rig: RigOption = "demo",
    count: Annotated[int, typer.Option("--count", "-n", help="End after that many messages; 0 runs on.")] = 0,
    save: Annotated[
        Path | None, typer.Option("--save", help="Save images as PNG and clouds as PLY there.")
    ] = None,
    timeout_s: Annotated[
        float, typer.Option("--timeout", help="Give up when nothing comes for so long.")
    ] = 10.0,
    as_json: JsonOption = False,
) -> None:
    """Print a stream as it passes, or save its images and clouds.

    A tap keeps the latest message only: it never slows the stack down.

    Examples: endo3d tap pose; endo3d tap cloud --save clouds -n 1; endo3d tap status --json | jq .rate_hz
    """
    from endo3d.services import tap as reader
    from endo3d.services.cli.control import where
    from endo3d.services.runtime.errors import UserError

    rig, topic = _topic(key, rig)
    name, port = where(rig)
    if save:
        save.mkdir(parents=True, exist_ok=True)
    for shown, message in enumerate(reader.tap(topic, rig=name, port=port, timeout_s=timeout_s), 1):
        line = json.dumps(plain(message)) if as_json else one_line(message)
        files = saved(message, save) if save else []
        print(line, *(f"-> {path}" for path in files), flush=True)
        if shown == count:
            return
    raise UserError(f"nothing on {topic.key(name)} for {timeout_s:g} s; endo3d top shows who is there")


def _topic(key: str, rig: str) -> tuple[str, Topic]:
    """The rig and the topic meant by ``pose``, ``status/decoder`` or ``endo3d/demo/pose``."""
    from endo3d.schemas.topics import BY_NAME
    from endo3d.services.runtime.errors import UserError

    if key.startswith("endo3d/"):
        _, rig, key = key.split("/", 2)
    for topic in BY_NAME.values():
        if key == topic.name or (topic.per_service and key.startswith(f"{topic.name}/")):
            return rig, topic
    raise UserError(f"no topic {key!r}; there are: {', '.join(BY_NAME)}")


def plain(message: Message) -> dict[str, Any]:
    """A message as plain values; large arrays as shape and dtype."""
    return {name: _plain(getattr(message, name)) for name in message.__dataclass_fields__}


def _plain(value: Any) -> Any:
    import numpy as np

    if isinstance(value, np.ndarray):
        if value.size <= SMALL and value.dtype.names is None:
            return value.tolist()
        return {"shape": list(value.shape), "dtype": str(value.dtype)}
    return dict(value) if hasattr(value, "items") else value


def one_line(message: Message) -> str:
    """A message for people: kind, then what is in it."""
    parts = []
    for name, value in plain(message).items():
        if isinstance(value, dict) and "shape" in value:
            value = "x".join(map(str, value["shape"])) + " " + value["dtype"].split("{")[0][:8]
        elif isinstance(value, float):
            value = f"{value:.6g}"
        elif isinstance(value, str) and "\n" in value:
            value = f"{len(value)} characters"
        parts.append(f"{name}={value}")
    return f"{type(message).__name__} " + " ".join(parts)


def saved(message: Message, folder: Path) -> list[Path]:
    """Write the images and clouds of a message; the files written, none for a message without any."""
    import cv2

    from endo3d.schemas.messages import Cloud, DepthMap, Frame, MapDelta
    from endo3d.services.exchange.ply import write_ply

    match message:
        case Frame(image=image):
            path = folder / f"frame_{message.sequence:08d}.png"
            cv2.imwrite(str(path), image)
        case DepthMap(depth=depth):
            path = folder / f"depth_{message.sequence:08d}.png"
            cv2.imwrite(str(path), depth)
        case Cloud(points=points):
            path = folder / f"cloud_{message.sequence:08d}.ply"
            write_ply(points, path)
        case MapDelta(points=points):
            path = folder / f"map_{message.revision:08d}.ply"
            write_ply(points, path)
        case _:
            return []
    return [path]
