"""``endo3d exposure``: how long each pattern is shown."""

from __future__ import annotations

from typing import Annotated

import typer

from endo3d.services.cli.options import JsonOption, RigOption


def exposure(
    exposure_us: Annotated[
        float, typer.Argument(metavar="MICROSECONDS", help="Exposure of every pattern.", min=1.0)
    ],
    rig: RigOption = "demo",
    as_json: JsonOption = False,
) -> None:
    """Set the exposure of every pattern, while the stack runs.

    Example: endo3d exposure 5000
    """
    from endo3d.services.cli.control import command, show

    show(command(rig, "sequencer", "exposure", {"exposure_us": exposure_us}), as_json)
