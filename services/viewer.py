"""The viewer: the live scan in Rerun, at the pace of an eye. Nothing in the pipeline ever waits for it."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from endo3d.schemas import topics
from endo3d.schemas.messages import Message
from endo3d.schemas.topics import Topic
from endo3d.services.runtime.service import Config, Service
from endo3d.services.views.viewer_process import ViewerProcess, has_display

if TYPE_CHECKING:  # Rerun takes half a second to import: only the process that shows something waits for it
    from endo3d.services.views.sink import Sink, ViewerSink

log = logging.getLogger(__name__)


class ViewerConfig(Config):
    show: Literal["auto", "window", "web", "connect", "none"] = "auto"
    """``auto`` is a window where there is a display, else a page for browsers, on this machine only."""
    url: str = "rerun+http://127.0.0.1:9876/proxy"
    """The running viewer to ``connect`` to."""
    port: int = 9876
    """Of the Rerun program that this service starts; 0 takes any free one."""
    web_port: int = 9090
    save: Path | None = None
    """Also write this .rrd recording."""
    rate_hz: float = Field(30.0, gt=0, le=30)
    """Of images and poses; nothing is shown faster."""
    cloud_hz: float = Field(10.0, gt=0, le=30)
    """Of single clouds and depth maps."""
    map_hz: float = Field(2.0, gt=0, le=30)
    colour: Literal["height", "quality"] = "height"


class Viewer(Service[ViewerConfig]):
    """Everything that can be seen -> Rerun."""

    Config = ViewerConfig
    reads = (
        topics.FRAME,
        topics.CLOUD,
        topics.DEPTH,
        topics.POSE,
        topics.MAP,
        topics.MODE,
        topics.CAMERA,
        topics.PROJECTOR,
        topics.STATUS,
        topics.LOG,
    )
    optional = reads
    nice = 10

    def __init__(self, config: ViewerConfig) -> None:
        from endo3d.services.views.display import Display

        super().__init__(config)
        self.display = Display(config.rate_hz, config.cloud_hz, config.map_hz, config.colour)
        self.sinks: list[Sink] = []
        self.viewer: ViewerSink | None = None
        self.process: ViewerProcess | None = None

    def open(self) -> None:
        """Starts or finds the viewer, opens the recording. Raises ``UserError``."""
        from endo3d.services.views.blueprint import scan_blueprint
        from endo3d.services.views.sink import FileSink, ViewerSink

        if self.config.save is not None:
            self.sinks.append(FileSink(self.config.save, scan_blueprint()))
        match self._way():
            case "window":
                self.process = ViewerProcess(self.config.port)
            case "web":
                self.process = ViewerProcess(self.config.port, self.config.web_port)
                log.info("see the scan at %s or with: rerun --connect %s", self.process.page, self.process.url)
            case "connect":
                self._look_at(ViewerSink(self.config.url, scan_blueprint()))
        if self.process is not None:
            self._look_at(ViewerSink(self.process.url, scan_blueprint(), self.process.revive))

    def step(self, message: Message) -> Iterator[Message]:
        """Shows a message; yields nothing."""
        for entry in self.display.show(message):
            for sink in self.sinks:
                sink.log(message.stamp_ns, entry)
        return iter(())

    def newest_hz(self, topic: Topic) -> float | None:
        """What is not shown is not even decoded; of the map every change counts."""
        match topic:
            case topics.FRAME | topics.POSE:
                return self.config.rate_hz
            case topics.CLOUD | topics.DEPTH:
                return min(self.config.rate_hz, self.config.cloud_hz)
        return None

    def losses(self) -> Mapping[str, int]:
        return {"view:not taken": self.viewer.lost} if self.viewer and self.viewer.lost else {}

    def trouble(self) -> str:
        return self.viewer.trouble if self.viewer else ""

    def close(self) -> None:
        for sink in self.sinks:
            sink.close()
        if self.process is not None:
            self.process.stop()

    def _way(self) -> str:
        if self.config.show == "auto":
            return "window" if has_display() else "web"
        return self.config.show

    def _look_at(self, viewer: ViewerSink) -> None:
        self.viewer = viewer
        self.sinks.append(viewer)
