"""Figures for Prometheus: what every service says of itself, as a page of text on the loopback. Optional.

    [metrics]
    port = 9464          # curl http://127.0.0.1:9464/metrics
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from pydantic import Field

from endo3d.schemas import topics
from endo3d.schemas.messages import Message, ServiceState, Status
from endo3d.services.runtime.errors import UserError
from endo3d.services.runtime.service import Config, Service

log = logging.getLogger(__name__)

LOOPBACK = "127.0.0.1"
GAUGES = {
    "rate_hz": "Steps per second on the main input.",
    "latency_p50_ms": "From the exposure of the newest frame involved to the end of the step, median.",
    "latency_p99_ms": "The same, 99th percentile.",
    "cpu_share": "Of one core.",
    "memory_mb": "Private memory.",
}
COUNTERS = {
    "received": "Messages read, per topic.",
    "published": "Messages written, per topic.",
    "dropped": "Messages lost, per cause.",
}


class MetricsConfig(Config):
    port: int = Field(9464, ge=0, le=65535)
    """On the loopback; 0 takes any free one."""


class Metrics(Service[MetricsConfig]):
    """The last status of every service, for whoever asks."""

    Config = MetricsConfig
    reads = (topics.STATUS,)
    nice = 10

    def __init__(self, config: MetricsConfig) -> None:
        super().__init__(config)
        self.statuses: dict[str, Status] = {}
        self._server: ThreadingHTTPServer | None = None

    @property
    def port(self) -> int:
        """Where it listens, once open."""
        return self._server.server_port if self._server is not None else 0

    def open(self) -> None:
        """Listens. Raises ``UserError`` for a port that is taken."""
        try:
            self._server = ThreadingHTTPServer((LOOPBACK, self.config.port), _page_of(self))
        except OSError as error:
            why = error.strerror
            raise UserError(f"metrics can't listen at port {self.config.port}: {why}; choose another") from None
        threading.Thread(target=self._server.serve_forever, name="metrics", daemon=True).start()
        log.info("at http://%s:%d/metrics", LOOPBACK, self.port)

    def step(self, message: Message) -> Iterator[Message]:
        if isinstance(message, Status):
            self.statuses = {**self.statuses, message.service: message}  # whoever reads keeps the old one
        return iter(())

    def close(self) -> None:
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()


def exposition(statuses: Mapping[str, Status]) -> str:
    """Prometheus' text format, version 0.0.4."""
    ordered = [status for _, status in sorted(statuses.items())]
    lines: list[str] = []
    for name, what in GAUGES.items():
        lines += _head(f"endo3d_{name}", "gauge", what)
        lines += [f"endo3d_{name}{_labels(status)} {_number(getattr(status, name))}" for status in ordered]
    lines += _head("endo3d_state", "gauge", "1 for the state that a service is in.")
    for status in ordered:
        lines += [f"endo3d_state{_labels(status, state=state)} {int(status.state is state)}" for state in ServiceState]
    for name, what in COUNTERS.items():
        lines += _head(f"endo3d_{name}_total", "counter", what)
        for status in ordered:
            counts = sorted(getattr(status, name).items())
            lines += [f"endo3d_{name}_total{_labels(status, what=key)} {count}" for key, count in counts]
    lines += _head("endo3d_value", "gauge", "A service's own figures.")
    for status in ordered:
        values = sorted(status.values.items())
        lines += [f"endo3d_value{_labels(status, name=key)} {_number(value)}" for key, value in values]
    return "\n".join(lines) + "\n"


def _head(name: str, kind: str, what: str) -> list[str]:
    return [f"# HELP {name} {what}", f"# TYPE {name} {kind}"]


def _labels(status: Status, **more: str) -> str:
    labels = {"host": status.host, "service": status.service, **more}
    return "{" + ",".join(f'{key}="{_escaped(value)}"' for key, value in labels.items()) + "}"


def _escaped(text: str) -> str:
    return text.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")


def _number(value: float) -> str:
    """Prometheus spells them NaN, +Inf and -Inf."""
    text = repr(float(value))
    return {"nan": "NaN", "inf": "+Inf", "-inf": "-Inf"}.get(text, text)


def _page_of(metrics: Metrics) -> type[BaseHTTPRequestHandler]:
    class Page(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if self.path != "/metrics":
                self.send_error(404)
                return
            body = exposition(metrics.statuses).encode()
            self.send_response(200)
            self.send_header("Content-Type", "text/plain; version=0.0.4; charset=utf-8")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *arguments: object) -> None:
            """A line per scrape would drown the others."""

    return Page
