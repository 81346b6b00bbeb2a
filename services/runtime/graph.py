"""Who reads what from whom: derived from ``reads`` and ``writes``, checked, and drawn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from endo3d.schemas.topics import Topic
from endo3d.services.runtime import hosts
from endo3d.services.runtime.errors import UserError
from endo3d.services.runtime.stack_file import Entry, Stack


@dataclass(frozen=True)
class Edge:
    """One stream from its writer to one reader."""

    topic: Topic
    writer: str
    reader: str


@dataclass(frozen=True)
class Graph:
    """A stack's wiring."""

    rig: str
    entries: tuple[Entry, ...]
    edges: tuple[Edge, ...]

    def readers(self, writer: str, topic: Topic) -> list[str]:
        return [edge.reader for edge in self.edges if edge.writer == writer and edge.topic is topic]

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for ``--json``."""
        return {
            "rig": self.rig,
            "services": [
                {
                    "name": entry.name,
                    "module": entry.module,
                    "reads": [topic.key(self.rig) for topic in entry.kind.reads],
                    "writes": [topic.key(self.rig, entry.name) for topic in entry.kind.writes],
                    "config": entry.config.model_dump(mode="json"),
                }
                for entry in self.entries
            ],
            "edges": [
                {"key": edge.topic.key(self.rig), "from": edge.writer, "to": edge.reader}
                for edge in self.edges
            ],
        }

    def mermaid(self) -> str:
        """The graph in the language that README pages draw; one arrow per pair of services."""
        arrows = (f"    {a} -->|{'<br>'.join(names)}| {b}" for (a, b), names in self._pairs().items())
        return "\n".join(("flowchart LR", *arrows))

    def dot(self) -> str:
        """The graph for Graphviz."""
        arrows = (f'  "{a}" -> "{b}" [label="{" ".join(names)}"];' for (a, b), names in self._pairs().items())
        return "\n".join((f'digraph "{self.rig}" {{', "  rankdir=LR;", *arrows, "}"))

    def _pairs(self) -> dict[tuple[str, str], list[str]]:
        pairs: dict[tuple[str, str], list[str]] = {}
        for edge in self.edges:
            pairs.setdefault((edge.writer, edge.reader), []).append(edge.topic.name)
        return pairs


def of(stack: Stack) -> Graph:
    """The wiring of a stack.

    Raises ``UserError`` for two writers of a topic, a read that nobody writes, and hosts that can't work so.
    What the runner writes for every service (status, log) is left out.
    """
    entries = stack.entries
    writers: dict[str, str] = {}
    for entry in entries:
        for topic in entry.kind.writes:
            if topic.per_service:
                continue
            if topic.name in writers:
                raise UserError(
                    f"{stack.label}: {writers[topic.name]} and {entry.name} both write {topic.name!r};"
                    " remove one of the two tables"
                )
            writers[topic.name] = entry.name
    edges = []
    for entry in entries:
        for topic in entry.kind.reads:
            if topic.name in writers:
                edges.append(Edge(topic, writers[topic.name], entry.name))
            elif not topic.per_service and topic not in entry.kind.optional:
                raise UserError(
                    f"{stack.label}: {entry.name} reads {topic.name!r}, which nobody in this stack writes;"
                    " add a table for a service that does"
                )
    wiring = Graph(stack.rig.name, entries, tuple(edges))
    if stack.placement.hosts:
        hosts.check(stack.placement, wiring)
    return wiring
