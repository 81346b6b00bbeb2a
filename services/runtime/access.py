"""What may pass the router: everything is forbidden but this. A host is known by the name in its certificate.

Keys between hosts, all below ``endo3d/<rig>/``:

    lane/<from>/<to>/<topic>       what a host's services wrote, for another host
    lane/<from>/<to>/taken         the name of the topic of which it has taken a message
    control/<service>/<verb>       commands
    alive/<service>                who is there
    clock/<host>                   what time it is there
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from endo3d.schemas import topics
from endo3d.services.runtime.hosts import Placement, Role, common_name

TAKEN: Final = "taken"
"""Last part of the key on which a host says that it has taken a large message."""


def lane_key(rig: str, sender: str, receiver: str, rest: str) -> str:
    return f"endo3d/{rig}/lane/{sender}/{receiver}/{rest}"


def clock_key(rig: str, host: str) -> str:
    return f"endo3d/{rig}/clock/{host}"


def access_control(rig: str, placement: Placement) -> dict[str, Any]:
    """zenoh's ``access_control`` for a rig's router."""
    rules, subjects, policies = [], [], []
    for host, table in placement.hosts.items():
        own = [rule | {"id": f"{host}: {rule['id']}"} for rule in _rules(rig, placement, host, table.role)]
        rules += own
        subjects.append({"id": host, "cert_common_names": [common_name(table.role, host)]})
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [host]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _rules(rig: str, placement: Placement, host: str, role: Role) -> list[dict[str, Any]]:
    """Of one host; ``ingress`` is what it sends, ``egress`` what it is sent."""
    lane_in = lane_key(rig, "*", host, "**")
    reports = [lane_key(rig, host, "*", topic.name) for topic in topics.TOPICS if topic.per_service]
    reports.append(lane_key(rig, host, "*", TAKEN))
    alive, clock = topics.alive_key(rig, "*"), clock_key(rig, "*")
    instances = placement.on(host).values()
    own_alive = [topics.alive_key(rig, name) for name in instances]
    own_commands = [topics.control_key(rig, name, "*") for name in instances]
    commands = [topics.control_key(rig, "*", "*")]
    rules = [
        _rule("asks for", "ingress", ("declare_subscriber",), [lane_in]),
        _rule("is sent", "egress", ("put",), [lane_in]),
        _rule("asks who is there", "ingress", ("liveliness_query", "declare_liveliness_subscriber"), [alive]),
        _rule("is told who is there", "egress", ("liveliness_token", "reply"), [alive]),
        _rule("is there", "ingress", ("liveliness_token",), own_alive),
        _rule("asks the time", "ingress", ("query",), [clock]),
        _rule("is told the time", "egress", ("declare_queryable", "reply"), [clock]),
        _rule("reports", "ingress", ("put",), reports),
        _rule("is asked for reports", "egress", ("declare_subscriber",), reports),
    ]
    if role is not Role.VIEWER:
        rules += [
            _rule("commands", "ingress", ("query",), commands),
            _rule("is answered", "egress", ("declare_queryable", "reply"), commands),
            _rule("answers", "ingress", ("declare_queryable", "reply"), own_commands),
            _rule("is commanded", "egress", ("query",), own_commands),
        ]
    if role is Role.RIG:
        sent = [lane_key(rig, host, "*", "**")]
        rules += [
            _rule("sends", "ingress", ("put",), sent),
            _rule("is asked to send", "egress", ("declare_subscriber",), sent),
            _rule("has the time", "ingress", ("declare_queryable", "reply"), [clock_key(rig, host)]),
            _rule("is asked the time", "egress", ("query",), [clock_key(rig, host)]),
        ]
    return rules


def _rule(name: str, flow: str, messages: Sequence[str], keys: Sequence[str]) -> dict[str, Any]:
    return {
        "id": name,
        "permission": "allow",
        "flows": [flow],
        "messages": list(messages),
        "key_exprs": list(keys),
    }
