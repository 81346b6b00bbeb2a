"""The hosts of a stack, all on this machine: a mesh of its own for each, real router, relays and certificates."""

from __future__ import annotations

import socket
import threading
import uuid
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from endo3d.schemas import topics
from endo3d.schemas.messages import Message
from endo3d.schemas.topics import Topic
from endo3d.services.relay import Relay, RelayConfig
from endo3d.services.router import Router, RouterConfig
from endo3d.services.runtime import stack_file
from endo3d.services.runtime.bus import Bus
from endo3d.services.runtime.certificates import make_authority, make_host
from endo3d.services.runtime.stack_file import Stack

LIMIT_S = 150.0
SERVICES = """
[scanner]
module = "acting.scanner"
[decoder]
module = "acting.decoder"
{decoder}
[odometry]
module = "acting.odometry"
[viewer]
module = "acting.viewer"
host = "workstation"
"""
WORKSTATION = '[hosts.workstation]\nrole = "{role}"\n{keys}\n'


def free_port(count: int = 1) -> int:
    """The first of ``count`` free ports in a row."""
    while True:
        with ExitStack() as probes:
            first = probes.enter_context(socket.socket())
            first.bind(("127.0.0.1", 0))
            port: int = first.getsockname()[1]
            try:
                for number in range(port + 1, port + count):
                    probes.enter_context(socket.socket()).bind(("127.0.0.1", number))
            except (OSError, OverflowError):
                continue
            return port


def rig_of(name: str) -> str:
    """A rig's name of its own for every test."""
    return f"{name}-{uuid.uuid4().hex[:8]}"


def stack_of(rig: str, *, role: str = "operator", keys: str = "", hosts: str = "", decoder: str = "") -> Stack:
    """Rig and workstation, by default an operator's with a link of its own; ``hosts`` adds others."""
    text = (
        f'[rig]\nname = "{rig}"\n[hosts.rig]\nrole = "rig"\naddress = "127.0.0.1"\nport = {free_port()}\n'
        + WORKSTATION.format(role=role, keys=keys)
        + hosts
        + SERVICES.format(decoder=decoder)
    )
    return stack_file.loads(text)


def make_keys(stack: Stack, folder: Path) -> None:
    make_authority(folder, stack.rig.name, 2)
    for name, host in stack.placement.hosts.items():
        make_host(folder, folder, name, host.role, [], 2)


def _itself(message: Message) -> object:
    return message


class Seen:
    """What came on a bus; ``wait`` for what should."""

    def __init__(self, bus: Bus, *wanted: Topic, keep: Callable[[Any], object] = _itself) -> None:
        """keep: what to keep of a message: arrays that are kept keep their shared memory, which is bounded."""
        self.messages: dict[Topic, list[Any]] = defaultdict(list)
        self._keep = keep
        self._came = threading.Condition()
        for topic in wanted:
            bus.subscribe(topic, self._take)

    def _take(self, message: Message) -> None:
        with self._came:
            self.messages[topics.of(message)].append(self._keep(message))
            self._came.notify_all()

    def wait(self, condition: Callable[[dict[Topic, list[Any]]], bool]) -> None:
        with self._came:
            came = self._came.wait_for(lambda: condition(self.messages), LIMIT_S)
        assert came, {topic.name: len(messages) for topic, messages in self.messages.items()}


class Repeating(threading.Thread):
    """Does something again and again, as long as the ``with`` lasts."""

    def __init__(self, work: Callable[[], object]) -> None:
        super().__init__(daemon=True)
        self._work = work
        self._done = threading.Event()

    def run(self) -> None:
        while not self._done.is_set():
            self._work()
            self._done.wait(0.05)

    def __enter__(self) -> None:
        self.start()

    def __exit__(self, *error: object) -> None:
        self._done.set()
        self.join()


class Alive:
    """Who is there, as a bus sees it."""

    def __init__(self, bus: Bus) -> None:
        self.services: set[str] = set()
        self._changed = threading.Condition()
        bus.watch_alive(self._see)

    def _see(self, service: str, there: bool) -> None:
        with self._changed:
            (self.services.add if there else self.services.discard)(service)
            self._changed.notify_all()

    def wait(self, condition: Callable[[set[str]], bool]) -> None:
        with self._changed:
            assert self._changed.wait_for(lambda: condition(self.services), LIMIT_S), self.services


class Host:
    """A host's mesh, and its relay on it."""

    def __init__(self, stack: Stack, name: str, keys: Path, closing: ExitStack, relay: type[Relay] = Relay) -> None:
        self.stack, self.name, self.port = stack, name, free_port(16)
        self._closing = closing
        self.bus = self.open(f"relay-{name}")
        self.relay = relay(RelayConfig(rig=stack.rig.name, stack_toml=stack.toml, host=name, keys=keys))
        self.relay.open()
        self.relay.connect(self.bus)
        closing.callback(self.relay.close)
        self.bus.declare_alive()

    def open(self, name: str) -> Bus:
        """Another process's place on this host's mesh."""
        return self._closing.enter_context(Bus.open(self.stack.rig.name, name=name, port=self.port))


def router_of(stack: Stack, keys: Path) -> Router:
    return Router(RouterConfig(rig=stack.rig.name, stack_toml=stack.toml, host="rig", keys=keys))


@contextmanager
def hosts_of(stack: Stack, keys: Path, **relays: type[Relay]) -> Iterator[dict[str, Host]]:
    """All hosts, joined: every relay sees every other one."""
    make_keys(stack, keys)
    with ExitStack() as closing:
        router = router_of(stack, keys)
        router.open()
        closing.callback(router.close)
        hosts = {
            name: Host(stack, name, keys, closing, relays.get(name, Relay)) for name in stack.placement.hosts
        }
        for host in hosts.values():
            others = {f"relay-{name}" for name in hosts if name != host.name}
            Alive(host.bus).wait(lambda there, others=others: others <= there)  # type: ignore[misc]
        yield hosts
