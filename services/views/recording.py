"""A log as an .rrd recording, with the layout inside: merged cloud, way, images, plots."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from endo3d.schemas.messages import Message
from endo3d.services.views.blueprint import scan_blueprint
from endo3d.services.views.display import Display
from endo3d.services.views.sink import FileSink, Sink

RATE_HZ, CLOUD_HZ, MAP_HZ = 15.0, 10.0, 1.0


def write_rrd(messages: Iterable[Message], path: str | Path, display: Display | None = None) -> None:
    """Writes messages in their order, thinned to 15 Hz, the map once a second and at the end."""
    sink = FileSink(Path(path), scan_blueprint())
    try:
        play(messages, sink, display or Display(RATE_HZ, CLOUD_HZ, MAP_HZ))
    finally:
        sink.close()


def play(messages: Iterable[Message], sink: Sink, display: Display) -> None:
    """Shows messages one after the other, and the whole map after the last."""
    last_ns = 0
    for message in messages:
        last_ns = max(last_ns, message.stamp_ns)
        for entry in display.show(message):
            sink.log(message.stamp_ns, entry)
    for entry in display.map_now():
        sink.log(last_ns, entry)
    sink.lay_out(scan_blueprint(display.stand()))
