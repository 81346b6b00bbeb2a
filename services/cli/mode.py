"""``endo3d mode``: what the projector shows."""

from __future__ import annotations

from typing import Annotated

import typer

from endo3d.services.cli.options import JsonOption, RigOption


def mode(
    name: Annotated[str, typer.Argument(help="conventional, interleaved, or a pattern set as text.")],
    rig: RigOption = "demo",
    as_json: JsonOption = False,
) -> None:
    """Switch what the projector shows, while the stack runs.

    Examples: endo3d mode conventional; endo3d mode "interleaved f1=15"
    """
    from endo3d.services.cli.control import command, show

    show(command(rig, "sequencer", "mode", {"mode": name}), as_json)
