"""Beyond this host: the router, and lines to it. Always mutual TLS; nothing here knows what travels."""

from __future__ import annotations

import contextlib
import json
import logging
import threading
from collections.abc import Callable, Mapping
from typing import Any, Final

import zenoh
from zenoh.handlers import FifoChannel

from endo3d.schemas.topics import Topic
from endo3d.services.runtime.access import access_control
from endo3d.services.runtime.errors import UserError
from endo3d.services.runtime.hosts import Placement
from endo3d.services.runtime.identity import Identity
from endo3d.services.runtime.reader import Reader
from endo3d.services.runtime.service import Refused, Sample
from endo3d.services.runtime.tally import Tally

log = logging.getLogger(__name__)

_LEASE_MS: Final = 2_000
"""Silence after which a link counts as cut."""
_EGRESS_US: Final = 500_000
"""How long the router lets a large message wait for a link: it forwards for others in the same two threads."""
_AGAIN_S: Final = 0.5
_SEQUENCE_MASK: Final = 0xFFFF_FFFF

_COMMON: Final[Mapping[str, Any]] = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "transport/shared_memory/enabled": False,
    "transport/link/protocols": ["tls"],
    "transport/link/tx/lease": _LEASE_MS,
    "transport/unicast/open_timeout": _LEASE_MS,
    "transport/unicast/accept_timeout": _LEASE_MS,
    "transport/link/tx/queue/size/data_high": 16,
    "transport/link/tx/queue/size/data": 16,
    "adminspace/enabled": False,
}


def router_settings(rig: str, placement: Placement, identity: Identity) -> dict[str, Any]:
    """The router's zenoh configuration, path -> value; a stock ``zenohd`` takes the same."""
    return {
        "mode": "router",
        "listen/endpoints": [placement.endpoint],
        **_COMMON,
        **identity.listening(),
        # A router that waits for one host waits for all. Large messages are held back by their sender instead.
        "qos/network": [
            {
                "id": "never wait",
                "messages": ["put"],
                "flows": ["egress"],
                "key_exprs": [f"endo3d/{rig}/lane/**"],
                "overwrite": {"congestion_control": "drop"},
            }
        ],
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": _EGRESS_US // 5,
        "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": _EGRESS_US,
        "access_control": access_control(rig, placement),
    }


def nested(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings as the tree that a configuration file holds."""
    tree: dict[str, Any] = {}
    for path, value in settings.items():
        *folders, name = path.split("/")
        place = tree
        for folder in folders:
            place = place.setdefault(folder, {})
        place[name] = value
    return tree


class Router:
    """A zenoh session that forwards between hosts, as far as the access control lets it."""

    def __init__(self, settings: Mapping[str, Any]) -> None:
        """Raises ``UserError`` when the address is not this host's or the port is taken."""
        try:
            self._session = _open(settings)
        except zenoh.ZError as error:
            where = ", ".join(settings["listen/endpoints"])
            raise UserError(f"the router can't listen at {where}: {_first_line(error)}; check the address") from None

    @property
    def connected(self) -> int:
        """How many lines there are to it; every host has one to every other, and one for itself."""
        return len(self._session.info.transports())

    def close(self) -> None:
        self._session.close()


class Line(threading.Thread):
    """A session with the router: opened as soon as that answers, and again by itself after every cut.

    What is declared on it before stays declared.
    """

    def __init__(self, endpoint: str, identity: Identity, opened: Callable[[Line], None]) -> None:
        """``opened`` is called once, in a thread of its own."""
        super().__init__(name="line", daemon=True)
        self._endpoint = endpoint
        self._settings = {
            **_COMMON,
            **identity.connecting(),
            "mode": "client",
            "connect/endpoints": [endpoint],
            "connect/timeout_ms": 0,
            "connect/exit_on_failure": True,
            "connect/retry": {"period_init_ms": 100, "period_max_ms": 1_000, "period_increase_factor": 2},
        }
        self._opened = opened
        self._session: zenoh.Session | None = None
        self._closing = threading.Event()
        self._tokens: dict[str, zenoh.LivelinessToken] = {}
        self._declared: list[Any] = []
        self._readers: list[Reader] = []

    def run(self) -> None:
        said = False
        while not self._closing.is_set():
            try:
                self._session = _open(self._settings)
            except zenoh.ZError as error:
                if not said:
                    log.warning("no router at %s yet: %s", self._endpoint, _first_line(error))
                    said = True
                self._closing.wait(_AGAIN_S)
            else:
                self._opened(self)
                return

    @property
    def up(self) -> bool:
        """Whether the router is there now."""
        return self._session is not None and bool(self._session.info.routers_zid())

    def sender(self, key: str, *, large: bool) -> Callable[[bytes], None]:
        """What puts samples on ``key``, numbered. Lost while the link is cut; what is large also when it is slow."""
        publisher = self._there().declare_publisher(
            key,
            congestion_control=zenoh.CongestionControl.BLOCK,
            priority=zenoh.Priority.DATA if large else zenoh.Priority.DATA_HIGH,  # small ones overtake
            express=True,
        )
        self._declared.append(publisher)
        sequence = 0

        def put(payload: bytes) -> None:
            nonlocal sequence
            with contextlib.suppress(zenoh.ZError):  # closing
                publisher.put(payload, source_info=zenoh.SourceInfo(publisher.id, sequence))
            sequence = (sequence + 1) & _SEQUENCE_MASK

        return put

    def listen(self, key: str, take: Callable[[bytes], None]) -> None:
        """Call ``take`` with what is put on ``key``: something small, and quickly done with."""
        self._declared.append(self._there().declare_subscriber(key, lambda sample: take(sample.payload.to_bytes())))

    def receive(self, key: str, topic: Topic, deliver: Callable[[Sample], None], tally: Tally) -> None:
        """Call ``deliver`` with what comes on ``key``, in a thread of its own."""
        reader = Reader(self._there(), key, topic, deliver, None, tally, None)
        self._readers.append(reader)
        reader.start()

    def answer(self, key: str, reply: Callable[[str, bytes], bytes]) -> None:
        """Answer queries on ``key``: (key, payload) -> payload. ``Refused`` is passed on with its text."""
        queryable = self._there().declare_queryable(key, FifoChannel(16))
        self._declared.append(queryable)
        threading.Thread(target=_answer_all, args=(queryable, reply), name=f"answer {key}", daemon=True).start()

    def ask(self, key: str, payload: bytes, timeout_s: float) -> bytes | None:
        """The first answer to a query, None when nobody answers. Raises ``Refused``."""
        if self._session is None:
            return None
        try:
            for reply in self._session.get(
                key, payload=payload, timeout=timeout_s, priority=zenoh.Priority.INTERACTIVE_HIGH
            ):
                if reply.ok is not None:
                    return reply.ok.payload.to_bytes()
                if reply.err is not None and reply.err.encoding == zenoh.Encoding.TEXT_PLAIN:
                    raise Refused(reply.err.payload.to_string())
        except zenoh.ZError as error:  # closing
            log.debug("no answer on %s: %s", key, error)
        return None

    def show(self, key: str) -> None:
        """Others see the liveliness token ``key`` from now on."""
        if key not in self._tokens:
            self._tokens[key] = self._there().liveliness().declare_token(key)

    def hide(self, key: str) -> None:
        if token := self._tokens.pop(key, None):
            token.undeclare()

    def watch(self, key: str, see: Callable[[str, bool], None]) -> None:
        """Call ``see(key, is_there)`` for all tokens that are there, and whenever one comes or goes."""

        def deliver(sample: zenoh.Sample) -> None:
            see(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        self._declared.append(self._there().liveliness().declare_subscriber(key, deliver, history=True))

    def close(self) -> None:
        self._closing.set()
        if self.is_alive():
            self.join()
        for token in self._tokens.values():
            token.undeclare()
        for reader in self._readers:
            reader.close()
        if self._session is not None:
            with contextlib.suppress(zenoh.ZError):
                self._session.close()

    def _there(self) -> zenoh.Session:
        assert self._session is not None
        return self._session


def _open(settings: Mapping[str, Any]) -> zenoh.Session:
    config = zenoh.Config()
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)


def _answer_all(queryable: zenoh.Queryable[Any], reply: Callable[[str, bytes], bytes]) -> None:
    for query in queryable.handler:
        with query:
            try:
                answer = reply(str(query.key_expr), query.payload.to_bytes() if query.payload else b"")
            except Refused as error:
                query.reply_err(str(error), encoding=zenoh.Encoding.TEXT_PLAIN)
            else:
                query.reply(query.key_expr, answer)


def _first_line(error: Exception) -> str:
    """zenoh's messages end with where in its sources they were made."""
    return str(error).splitlines()[0].split(" at /")[0].strip()
