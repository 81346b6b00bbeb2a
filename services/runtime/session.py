"""A process's zenoh session: who it meets, and whether it may use shared memory.

Processes of a rig meet without a router, in any start order, and survive each other: sixteen loopback ports
follow from the rig's name. Each process listens on the first that is free and connects to all the others,
again and again, so any two that run are connected. Whoever comes as the seventeenth is told of the others
by gossip.
"""

from __future__ import annotations

import ctypes
import errno
import json
import mmap
import resource
import socket
import time
import zlib
from collections.abc import Mapping
from typing import Any, Final

import zenoh

from endo3d.services.runtime.errors import UserError

_FIRST_PORT: Final = 20_000
_MEETING_PORTS: Final = 16
_RIGS: Final = 798
"""Names that have ports of their own, below 32768, where systems begin to give out ports themselves."""
_LOOPBACK: Final = "127.0.0.1"
_ANSWER_MS: Final = 1_000
_MLOCK_ONFAULT: Final = 1


def meeting_ports(rig: str, first: int | None = None) -> range:
    """A rig's meeting ports: from ``first`` on, or as they follow from its name.

    Rigs that happen to share their ports share connections, but no keys.
    """
    if first is None:
        first = _FIRST_PORT + _MEETING_PORTS * (zlib.crc32(rig.encode()) % _RIGS)
    return range(first, first + _MEETING_PORTS)


def open_session(ports: range, *, shared_memory: bool, settings: Mapping[str, Any] | None = None) -> zenoh.Session:
    """Join the processes that meet at ``ports``.

    settings: zenoh configuration, path -> value, over the built-in one (endpoints of other hosts, TLS).
    Raises ``UserError`` when all ports belong to foreign programs, or zenoh refuses the settings.
    """
    for port in ports:
        if _is_free(port):
            try:
                return _open(_settings(ports, port, shared_memory) | dict(settings or {}))
            except zenoh.ZError as error:
                if _is_free(port):
                    raise UserError(f"zenoh does not start: {error}; check the stack file's zenoh settings") from None
    session = _open(_settings(ports, None, shared_memory) | dict(settings or {}))
    if not _meets_someone(session):
        session.close()
        raise UserError(
            f"ports {ports[0]}..{ports[-1]} are busy and no process of a rig answers there; "
            "give the rig another name or another port"
        )
    return session


def lockable(size: int) -> bool:
    """Whether this process may lock ``size`` more bytes of memory; the limit is raised where permitted.

    Every process locks the pools of all it talks to; a reader whose limit is too low gets nothing, silently.
    """
    if _can_lock(size):
        return True
    hard = resource.getrlimit(resource.RLIMIT_MEMLOCK)[1]
    for limits in ((resource.RLIM_INFINITY, resource.RLIM_INFINITY), (hard, hard)):
        try:
            resource.setrlimit(resource.RLIMIT_MEMLOCK, limits)
        except (ValueError, PermissionError):
            continue
        if _can_lock(size):
            return True
    return False


def _settings(ports: range, listen: int | None, shared_memory: bool) -> dict[str, Any]:
    def endpoint(port: int) -> str:
        return f"tcp/{_LOOPBACK}:{port}"

    return {
        "mode": "peer",
        "listen/endpoints": [endpoint(listen or 0)],
        "connect/endpoints": [endpoint(port) for port in ports if port != listen],
        "connect/exit_on_failure": False,
        "connect/timeout_ms": -1,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 2000, "period_increase_factor": 2},
        "scouting/delay": 0,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": True,
        # Two peers that hear of each other at once would otherwise connect twice.
        "scouting/gossip/autoconnect_strategy": {"peer": {"to_router": "always", "to_peer": "greater-zid"}},
        # Who does not answer (a stopped process, a foreign program) must not hold up a start or an end,
        "transport/unicast/open_timeout": _ANSWER_MS,
        "transport/unicast/accept_timeout": _ANSWER_MS,
        # and a stopped reader keeps what was sent to it until its link is cut: a writer's pool lasts 0.2 s.
        "transport/link/tx/lease": _ANSWER_MS,
        # A busy machine may let the sending thread wait: bursts are queued meanwhile.
        "transport/link/tx/queue/size/data": 16,
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 5_000,
        # The caches of latched topics go by timestamps.
        "timestamping/enabled": True,
        "transport/shared_memory/enabled": shared_memory,
        # Implicit copies into shared memory use a pool that blocks; ours are explicit.
        "transport/shared_memory/transport_optimization/enabled": False,
    }


def _open(settings: Mapping[str, Any]) -> zenoh.Session:
    config = zenoh.Config()
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)


def _is_free(port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((_LOOPBACK, port))
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                return False
            raise
    return True


def _meets_someone(session: zenoh.Session) -> bool:
    deadline = time.monotonic() + _ANSWER_MS / 1000
    while time.monotonic() < deadline:
        if session.info.peers_zid() or session.info.routers_zid():
            return True
        time.sleep(0.01)
    return False


def _can_lock(size: int) -> bool:
    """Locks without touching: the limit is checked, no page is taken."""
    libc = ctypes.CDLL(None, use_errno=True)
    with mmap.mmap(-1, size) as memory:
        view = (ctypes.c_char * size).from_buffer(memory)
        locked: int = libc.mlock2(ctypes.byref(view), ctypes.c_size_t(size), _MLOCK_ONFAULT)
        libc.munlock(ctypes.byref(view), ctypes.c_size_t(size))
        del view
    return locked == 0
