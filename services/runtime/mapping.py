"""Readers map a writer's pool before the first frame: mapping and locking it takes up to 80 ms, many frames.

A writer offers a few bytes of each pool: at once to the readers that are there, and on request to later ones.
"""

from __future__ import annotations

import zenoh

from endo3d.schemas.topics import Topic

_ASK_S = 1.0


def key(rig: str, topic: Topic) -> str:
    """Where the pool of a topic is offered."""
    return f"endo3d/{rig}/pool/{topic.name}"


def offer(session: zenoh.Session, key: str, piece: zenoh.ZBytes) -> zenoh.Queryable[None]:
    """Let all readers map the pool that ``piece`` is of, now and later."""

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, piece)

    queryable = session.declare_queryable(key, answer)
    session.put(key, piece)
    return queryable


def map_offered(session: zenoh.Session, key: str) -> zenoh.Subscriber[None]:
    """Map what is offered now, and from now on whatever comes. Receiving a piece maps its pool."""
    subscriber = session.declare_subscriber(key, lambda piece: None)
    pieces = session.get(
        key, target=zenoh.QueryTarget.ALL, consolidation=zenoh.ConsolidationMode.NONE, timeout=_ASK_S
    )
    for _ in pieces:
        pass
    return subscriber
