"""Who gets in, and what the router lets pass: plain zenoh sessions that try everything, with every certificate."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import zenoh
from one_machine import LIMIT_S, Repeating, make_keys, rig_of, router_of, stack_of

from endo3d.services.runtime.certificates import make_authority, make_host
from endo3d.services.runtime.hosts import Role
from endo3d.services.runtime.stack_file import Stack

LAPTOP = '[hosts.laptop]\nrole = "viewer"\nstreams = ["pose"]\n'
SOON_S = 0.4
"""For what must not come; what may come is there within milliseconds."""


@dataclass
class Guest:
    """A session with somebody's certificate, and what it got to see."""

    session: zenoh.Session
    rig: str
    seen: list[str] = field(default_factory=list)
    changed: threading.Condition = field(default_factory=threading.Condition)

    def listen(self, key: str) -> None:
        self.session.declare_subscriber(f"endo3d/{self.rig}/{key}", self._see, allowed_origin=zenoh.Locality.REMOTE)

    def put(self, key: str) -> None:
        self.session.put(f"endo3d/{self.rig}/{key}", b"x")

    def answer(self, key: str) -> None:
        def reply(query: zenoh.Query) -> None:
            self._note(f"asked {query.key_expr}")
            with query:
                query.reply(query.key_expr, b"done")

        self.session.declare_queryable(f"endo3d/{self.rig}/{key}", reply)

    def ask(self, key: str) -> list[bytes]:
        replies = self.session.get(f"endo3d/{self.rig}/{key}", timeout=SOON_S)
        return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]

    def wait(self, what: str) -> None:
        with self.changed:
            assert self.changed.wait_for(lambda: what in self.seen, LIMIT_S), (what, self.seen)

    def _see(self, sample: zenoh.Sample) -> None:
        self._note(str(sample.key_expr))

    def _note(self, what: str) -> None:
        with self.changed:
            self.seen.append(what.replace(f"endo3d/{self.rig}/", ""))
            self.changed.notify_all()


def settings_of(stack: Stack, keys: Path, name: str | None) -> dict[str, Any]:
    settings: dict[str, Any] = {
        "mode": "client",
        "connect/endpoints": [stack.placement.endpoint],
        "scouting/multicast/enabled": False,
        "transport/link/tls/root_ca_certificate": str(keys / "ca.pem"),
        "transport/link/tls/enable_mtls": name is not None,
    }
    if name is not None:
        settings["transport/link/tls/connect_certificate"] = str(keys / f"{name}.pem")
        settings["transport/link/tls/connect_private_key"] = str(keys / f"{name}.key")
    return settings


def open_session(settings: dict[str, Any]) -> zenoh.Session:
    config = zenoh.Config()
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)


@pytest.fixture
def stack() -> Stack:
    return stack_of(rig_of("access"), hosts=LAPTOP)


@pytest.fixture
def keys(stack: Stack, tmp_path: Path) -> Path:
    make_keys(stack, tmp_path / "keys")
    return tmp_path / "keys"


@pytest.fixture
def enter(stack: Stack, keys: Path) -> Iterator[Callable[[str], Guest]]:
    """Opens a session with the certificate of that name, while the router runs."""
    with ExitStack() as closing, router(stack, keys):

        def come_in(name: str, folder: Path = keys) -> Guest:
            session = open_session(settings_of(stack, folder, name))
            closing.callback(session.close)
            return Guest(session, stack.rig.name)

        yield come_in


@contextmanager
def router(stack: Stack, keys: Path) -> Iterator[None]:
    service = router_of(stack, keys)
    service.open()
    try:
        yield
    finally:
        service.close()


def test_the_way_of_a_scan_and_of_a_command(enter: Callable[[str], Guest]) -> None:
    rig, workstation = enter("rig"), enter("workstation")
    workstation.listen("lane/*/workstation/**")
    rig.answer("control/odometry/*")
    with Repeating(lambda: rig.put("lane/rig/workstation/pose")):
        workstation.wait("lane/rig/workstation/pose")
    deadline = time.monotonic() + LIMIT_S
    while not (answer := workstation.ask("control/odometry/reset")) and time.monotonic() < deadline:
        pass
    assert answer == [b"done"]


@pytest.mark.parametrize(
    ("who", "key"),
    [
        ("laptop", "lane/*/workstation/**"),
        ("laptop", "**"),
        ("workstation", "lane/*/laptop/**"),
    ],
)
def test_nobody_reads_what_is_another_hosts(enter: Callable[[str], Guest], who: str, key: str) -> None:
    rig, spy = enter("rig"), enter(who)
    receiver = enter("laptop" if who == "workstation" else "workstation")
    name = "laptop" if who == "workstation" else "workstation"
    spy.listen(key)
    receiver.listen(f"lane/*/{name}/**")
    with Repeating(lambda: rig.put(f"lane/rig/{name}/pose")):
        receiver.wait(f"lane/rig/{name}/pose")
        time.sleep(SOON_S)
    assert spy.seen == []


@pytest.mark.parametrize(
    ("who", "key"),
    [
        ("laptop", "lane/rig/workstation/pose"),
        ("laptop", "lane/laptop/workstation/pose"),
        ("workstation", "lane/rig/laptop/status"),
        ("workstation", "lane/workstation/rig/frame"),
    ],
)
def test_nobody_says_what_is_another_hosts(enter: Callable[[str], Guest], who: str, key: str) -> None:
    rig, forger = enter("rig"), enter(who)
    name = key.split("/")[2]
    receiver = rig if name == "rig" else enter(name)
    receiver.listen(f"lane/*/{name}/**")
    allowed = f"lane/{who}/{name}/status" if who == "laptop" or name == "rig" else f"lane/{who}/{name}/log"
    with Repeating(lambda: (forger.put(key), forger.put(allowed))):
        receiver.wait(allowed)
        time.sleep(SOON_S)
    assert key not in receiver.seen


def test_a_viewer_commands_nobody_and_answers_for_nobody(enter: Callable[[str], Guest]) -> None:
    rig, laptop, workstation = enter("rig"), enter("laptop"), enter("workstation")
    rig.answer("control/odometry/*")
    laptop.answer("control/decoder/*")
    deadline = time.monotonic() + LIMIT_S
    while not workstation.ask("control/odometry/reset") and time.monotonic() < deadline:
        pass
    asked = len(rig.seen)
    assert asked, "an operator is answered"
    assert laptop.ask("control/odometry/reset") == []
    assert workstation.ask("control/decoder/reset") == []
    assert len(rig.seen) == asked
    assert laptop.seen == []


def test_a_stranger_does_not_get_in(stack: Stack, keys: Path, tmp_path: Path) -> None:
    """No certificate; one of another authority; no TLS at all."""
    make_authority(tmp_path / "other", "other", 2)
    make_host(tmp_path / "other", tmp_path / "other", "rig", Role.RIG, [], 2)
    foreign = settings_of(stack, tmp_path / "other", "rig")
    foreign["transport/link/tls/root_ca_certificate"] = str(keys / "ca.pem")
    plain = {
        "mode": "client",
        "connect/endpoints": [stack.placement.endpoint.replace("tls/", "tcp/")],
        "scouting/multicast/enabled": False,
    }
    with router(stack, keys):
        open_session(settings_of(stack, keys, "rig")).close()
        for settings in (settings_of(stack, keys, None), foreign, plain):
            with pytest.raises(zenoh.ZError):
                open_session(settings | {"transport/unicast/open_timeout": 2_000, "connect/timeout_ms": 0})


def test_a_host_that_the_stack_does_not_know_sees_nothing(enter: Callable[..., Guest], keys: Path) -> None:
    """Its certificate is of the right authority."""
    make_host(keys, keys, "newcomer", Role.OPERATOR, [], 2)
    rig, newcomer, workstation = enter("rig"), enter("newcomer"), enter("workstation")
    newcomer.listen("**")
    newcomer.listen("lane/*/workstation/**")
    workstation.listen("lane/*/workstation/**")
    rig.answer("control/odometry/*")
    with Repeating(lambda: (rig.put("lane/rig/workstation/pose"), newcomer.put("lane/rig/workstation/mode"))):
        workstation.wait("lane/rig/workstation/pose")
        time.sleep(SOON_S)
    assert newcomer.seen == []
    assert newcomer.ask("control/odometry/reset") == []
    assert "lane/rig/workstation/mode" not in workstation.seen
    assert not [what for what in rig.seen if what.startswith("asked")]


def test_the_role_counts_not_only_the_host(enter: Callable[..., Guest], keys: Path, tmp_path: Path) -> None:
    """A viewer's certificate for the name of an operator's host."""
    other = tmp_path / "viewer"
    make_host(keys, other, "workstation", Role.VIEWER, [], 2)
    rig, false_operator = enter("rig"), enter("workstation", other)
    rig.answer("control/odometry/*")
    true_operator = enter("workstation")
    deadline = time.monotonic() + LIMIT_S
    while not true_operator.ask("control/odometry/reset") and time.monotonic() < deadline:
        pass
    asked = len(rig.seen)
    assert false_operator.ask("control/odometry/reset") == []
    assert len(rig.seen) == asked
