"""A process's zenoh session: who it meets, and whether it may use shared memory.

Processes of a rig meet without a router, in any start order, and survive each other: three loopback ports
are derived from the rig's name. Everybody keeps trying to connect to all three and to listen on one of
them, so whoever comes first is found by the rest, and when it goes another takes its port. Gossip then
connects everybody with everybody directly. Several holders, so that one stopped process locks nobody out.
"""

from __future__ import annotations

import ctypes
import errno
import json
import mmap
import os
import resource
import socket
import time
import zlib
from collections.abc import Mapping
from typing import Any, Final

import zenoh

from endo3d.services.runtime.errors import UserError

_FIRST_PORT: Final = 20_000
_RIGS: Final = 3_000
_MEETING_PORTS: Final = 3
_LOOPBACK: Final = "127.0.0.1"
_MEET_S: Final = 3.0
_MLOCK_ONFAULT: Final = 1


def meeting_port(rig: str) -> int:
    """The first of a rig's meeting ports, from its name; below the range that systems give out themselves."""
    return _FIRST_PORT + _MEETING_PORTS * (zlib.crc32(rig.encode()) % _RIGS)


def open_session(
    port: int, *, shared_memory: bool, settings: Mapping[str, Any] | None = None
) -> zenoh.Session:
    """Join the processes that meet at ``port``.

    settings: zenoh configuration, path -> value, over the built-in one (endpoints of other hosts, TLS).
    Raises ``UserError`` when all meeting ports belong to foreign programs, or zenoh refuses the settings.
    """
    ports = range(port, port + _MEETING_PORTS)
    free = [candidate for candidate in ports if _is_free(candidate)]
    listen = free[0] if free else ports[os.getpid() % _MEETING_PORTS]
    config = zenoh.Config()
    try:
        for path, value in {**_settings(ports, listen, shared_memory), **(settings or {})}.items():
            config.insert_json5(path, json.dumps(value))
        session = zenoh.open(config)
    except zenoh.ZError as error:
        raise UserError(f"zenoh does not start: {error}; check the stack file's zenoh settings") from None
    if not free and not _meets_someone(session):
        session.close()
        raise UserError(
            f"ports {ports[0]}..{ports[-1]} are busy and no process of this rig answers there; "
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


def _settings(ports: range, listen: int, shared_memory: bool) -> dict[str, Any]:
    def endpoint(port: int) -> str:
        return f"tcp/{_LOOPBACK}:{port}"

    again = {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2}
    return {
        "mode": "peer",
        "listen/endpoints": [endpoint(listen), endpoint(0)],
        "listen/exit_on_failure": False,
        "listen/timeout_ms": -1,
        "listen/retry": again,
        "connect/endpoints": [endpoint(port) for port in ports if port != listen],
        "connect/exit_on_failure": False,
        "connect/timeout_ms": -1,
        "connect/retry": again,
        "scouting/delay": 50,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": True,
        # Two peers that hear of each other at once would otherwise connect twice.
        "scouting/gossip/autoconnect_strategy": {"peer": {"to_router": "always", "to_peer": "greater-zid"}},
        # The caches of latched topics go by timestamps.
        "timestamping/enabled": True,
        "transport/shared_memory/enabled": shared_memory,
        # Implicit copies into shared memory use a pool that blocks; ours are explicit.
        "transport/shared_memory/transport_optimization/enabled": False,
    }


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
    deadline = time.monotonic() + _MEET_S
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
