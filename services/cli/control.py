"""Commands to running services: what ``mode``, ``exposure`` and ``record`` send."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from endo3d.services.runtime.bus import Bus


def where(rig: str) -> tuple[str, int | None]:
    """A rig's name and meeting port, given its name or its stack file."""
    from endo3d.services.runtime.stack_file import load

    if not rig.endswith(".toml"):
        return rig, None
    table = load(rig).rig
    return table.name, table.port


def join(rig: str) -> Bus:
    """The bus of a rig, given its name or its stack file."""
    from endo3d.services.runtime.bus import Bus

    name, port = where(rig)
    return Bus.open(name, name="cli", port=port)


def command(rig: str, service: str, verb: str, parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Send one command, and return the reply; a refusal is the user's to know."""
    from endo3d.services.runtime.errors import UserError
    from endo3d.services.runtime.service import Refused

    with join(rig) as bus:
        try:
            return bus.call(service, verb, parameters)
        except Refused as refusal:
            raise UserError(f"{service} refuses {verb}: {refusal}") from None


def show(reply: Mapping[str, Any], as_json: bool) -> None:
    """Print a reply."""
    import json

    if as_json:
        print(json.dumps(dict(reply)))
    else:
        print(", ".join(f"{key} {value}" for key, value in reply.items()) or "done")
