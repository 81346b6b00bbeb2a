"""Readers map a writer's pool before the first frame: mapping and locking it takes up to 80 ms, many frames.

A writer shows by a liveliness token that it has a pool, and gives a few bytes of it to who asks. A reader
that sees the token and gets nothing knows that shared memory does not work between the two: zenoh itself
would not say so, the frames would just never come.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable

import zenoh

from endo3d.schemas.topics import Topic

_ASK_S = 2.0
_TIMES = 5
"""A writer on a busy machine may be late with its answer: that alone is no reason for alarm."""


def key(rig: str, topic: Topic) -> str:
    """Where the pool of a topic is offered."""
    return f"endo3d/{rig}/pool/{topic.name}"


def offer(session: zenoh.Session, key: str, piece: zenoh.ZBytes) -> tuple[zenoh.Queryable[None], zenoh.LivelinessToken]:
    """Let readers map the pool that ``piece`` is of, now and later."""

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, piece)

    return session.declare_queryable(key, answer), session.liveliness().declare_token(key)


def map_offered(session: zenoh.Session, key: str, fail: Callable[[], None]) -> zenoh.Subscriber[None]:
    """Map the pools that are offered, now and from now on; ``fail`` is called when that can't be."""

    def take(token: zenoh.Sample) -> None:
        # Not in zenoh's own thread: it has two for all that comes in, the answers too.
        if token.kind == zenoh.SampleKind.PUT:
            threading.Thread(target=map_it, name="map", daemon=True).start()

    def map_it() -> None:
        with contextlib.suppress(zenoh.ZError):  # the session is closed
            if not any(_ask(session, key) for _ in range(_TIMES)) and _is_offered(session, key):
                fail()

    _ask(session, key)
    return session.liveliness().declare_subscriber(key, take, history=True)


def _is_offered(session: zenoh.Session, key: str) -> bool:
    return sum(reply.ok is not None for reply in session.liveliness().get(key, timeout=_ASK_S)) > 0


def _ask(session: zenoh.Session, key: str) -> bool:
    """Receiving a piece maps its pool. Whether any came."""
    pieces = session.get(key, target=zenoh.QueryTarget.ALL, consolidation=zenoh.ConsolidationMode.NONE, timeout=_ASK_S)
    return sum(reply.ok is not None for reply in pieces) > 0
