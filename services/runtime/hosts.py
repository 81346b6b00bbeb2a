"""The hosts of a stack: what ``[hosts.NAME]`` and a table's ``host = "NAME"`` say, and what follows from it.

    [hosts.rig]
    address = "192.168.7.1"          # where the others reach it: the router listens here
    role = "rig"

    [hosts.workstation]
    role = "operator"
    preview = {image_hz = 10}        # a thin link: reduced streams

    [viewer]
    host = "workstation"

    [decoder]
    host = ["left", "right"]         # shared: each takes every other piece of the frames

Every host's services meet on its own loopback, as those of a single host do. A relay on every host carries what
others read, through the router. Nothing else touches the network.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final

from pydantic import BaseModel, ConfigDict, Field

from endo3d.schemas import topics
from endo3d.schemas.topics import Topic
from endo3d.services.runtime.errors import UserError

if TYPE_CHECKING:
    from endo3d.services.runtime.graph import Graph

HOST_NAME: Final = r"[A-Za-z0-9][A-Za-z0-9-]{0,31}"
ROUTER: Final = "router"
RELAY: Final = "relay"


class Role(StrEnum):
    """What a host may do; its certificate says which."""

    RIG = "rig"
    """Takes part: its services read, write, command and are commanded."""
    OPERATOR = "operator"
    """Sees and commands."""
    VIEWER = "viewer"
    """Sees."""


def common_name(role: Role, host: str) -> str:
    """What a host's certificate says it is."""
    return f"{role}.{host}"


class Preview(BaseModel):
    """What a host on a thin link gets instead of everything."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    image_hz: float = Field(10.0, gt=0)
    image_step: int = Field(1, ge=1, le=8)
    """Pixels per pixel sent, along each axis."""
    jpeg_quality: int = Field(80, ge=10, le=100)
    cloud_hz: float = Field(2.0, gt=0)
    """Of clouds and depth maps."""
    cloud_step: int = Field(2, ge=1, le=8)
    """Grid points per point sent, along each axis."""
    map_hz: float = Field(5.0, gt=0)
    """Every change of the map arrives, but at most so often."""


class HostTable(BaseModel):
    """A ``[hosts.NAME]`` table."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    address: str = ""
    """Where other hosts reach it, name or number; the first host that has one runs the router."""
    port: int = Field(7447, ge=1, le=65535)
    role: Role = Role.VIEWER
    """What its certificate has to say: ``rig`` takes part, ``operator`` sees and commands, ``viewer`` sees."""
    preview: Preview | None = None
    """Its link is thin; None: it gets what it reads as it is."""
    own_router: bool = True
    """False: a stock ``zenohd`` listens there, and endo3d starts no router."""
    streams: tuple[str, ...] = ()
    """Topics sent to it though none of its services reads them: for ``tap`` and programs of your own."""


@dataclass(frozen=True)
class Lane:
    """What one host sends to another."""

    sender: str
    receiver: str
    topics: tuple[Topic, ...]
    shared: Mapping[str, str] = field(default_factory=dict)
    """Host -> name of the decoder there, of those that the frames are shared out between."""


@dataclass(frozen=True)
class Placement:
    """Which service of a stack runs where. Empty for a stack without hosts."""

    hosts: Mapping[str, HostTable]
    services: Mapping[str, tuple[str, ...]]
    """Table -> its hosts; more than one share its work."""

    @property
    def router(self) -> str:
        """The host that the others connect to."""
        return next(name for name, host in self.hosts.items() if host.address)

    @property
    def endpoint(self) -> str:
        """Where the router listens."""
        host = self.hosts[self.router]
        address = f"[{host.address}]" if ":" in host.address else host.address
        return f"tls/{address}:{host.port}"

    def on(self, host: str) -> dict[str, str]:
        """Table -> the name by which its instance on ``host`` goes, in flow order."""
        return {table: self.instance(table, host) for table, hosts in self.services.items() if host in hosts}

    def instance(self, table: str, host: str) -> str:
        """A service's own name, with its host's where there are several of it."""
        return f"{table}-{host}" if table == RELAY or len(self.services[table]) > 1 else table


def placement_of(hosts: Mapping[str, HostTable], tables: Mapping[str, Mapping[str, Any]]) -> Placement:
    """Where the services of ``tables`` run. Raises ``UserError`` for an unknown host and for hosts that can't meet."""
    if not hosts:
        if placed := next((table for table, keys in tables.items() if "host" in keys), None):
            raise UserError(f"[{placed}] names a host, but there is no [hosts.NAME] table; add one")
        return Placement({}, {})
    addressed = [name for name, host in hosts.items() if host.address]
    if not addressed:
        raise UserError('no host has an address, so none can be reached; add address = "..." to [hosts.NAME]')
    if hosts[addressed[0]].role is not Role.RIG:
        raise UserError(f'[hosts.{addressed[0]}] runs the router and has to be trusted: role = "rig"')
    services: dict[str, tuple[str, ...]] = {}
    for table, keys in tables.items():
        usual: tuple[str, ...] = tuple(hosts) if table == RELAY else (addressed[0],)
        if table == ROUTER and not hosts[addressed[0]].own_router:
            usual = ()
        given = keys.get("host", usual)
        services[table] = (given,) if isinstance(given, str) else tuple(given)
        for name in services[table]:
            if name not in hosts:
                raise UserError(f"[{table}] runs on {name!r}, but the hosts are {', '.join(hosts)}")
    return Placement(hosts, services)


def lanes(placement: Placement, wiring: Graph) -> list[Lane]:
    """What has to cross from every host to every other one: what is read there and written here, and how all do.

    Raises ``UserError`` for work that can't be shared and for a writer that isn't trusted.
    """
    return [
        Lane(sender, receiver, *_crossing(placement, wiring, sender, receiver))
        for sender in placement.hosts
        for receiver in placement.hosts
        if sender != receiver
    ]


def check(placement: Placement, wiring: Graph) -> None:
    """Raises ``UserError`` for work that can't be shared, a writer that isn't trusted, an unknown stream."""
    for name, host in placement.hosts.items():
        for stream in host.streams:
            if stream not in topics.BY_NAME:
                raise UserError(f"hosts.{name}.streams: no topic {stream!r}; there are: {', '.join(topics.BY_NAME)}")
    writers = {topic: entry.name for entry in wiring.entries for topic in entry.kind.writes}
    for entry in wiring.entries:
        hosts = placement.services[entry.name]
        if len(hosts) > 1 and entry.name != RELAY:
            frames = placement.services.get(writers.get(topics.FRAME, ""), ())
            if topics.FRAME not in entry.kind.reads or set(hosts) & set(frames):
                raise UserError(
                    f"[{entry.name}] can't be shared between {', '.join(hosts)}: "
                    "only a decoder can, between hosts that the frames come to"
                )
    for lane in lanes(placement, wiring):
        written = [topic.name for topic in lane.topics if not topic.per_service]
        if written and placement.hosts[lane.sender].role is not Role.RIG:
            raise UserError(f'{lane.sender} sends {", ".join(written)} to {lane.receiver}; it needs role = "rig"')


def _crossing(
    placement: Placement, wiring: Graph, sender: str, receiver: str
) -> tuple[tuple[Topic, ...], dict[str, str]]:
    wanted = set(placement.hosts[receiver].streams)
    shared: dict[str, str] = {}
    for edge in wiring.edges:
        readers = placement.services[edge.reader]
        if receiver in readers and receiver not in placement.services[edge.writer]:
            wanted.add(edge.topic.name)
            if len(readers) > 1 and edge.topic == topics.FRAME:
                shared = {host: placement.instance(edge.reader, host) for host in readers}
    written = {
        topic.name
        for entry in wiring.entries
        if sender in placement.services[entry.name]
        for topic in entry.kind.writes
    }
    crossing = [topic for topic in topics.TOPICS if topic.per_service or topic.name in wanted & written]
    return tuple(crossing), shared if topics.FRAME in crossing else {}
