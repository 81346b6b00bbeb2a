"""``endo3d record``: start and stop the recording of a running stack."""

from __future__ import annotations

from typing import Annotated

import typer

from endo3d.services.cli.options import JsonOption, RigOption

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)


@app.command()
def start(
    name: Annotated[str, typer.Option("--name", help="File name without suffix; else rig and time.")] = "",
    rig: RigOption = "demo",
    as_json: JsonOption = False,
) -> None:
    """Start a recording. Example: endo3d record start --name first-try"""
    from endo3d.services.cli.control import command, show

    show(command(rig, "recorder", "start", {"name": name}), as_json)


@app.command()
def stop(rig: RigOption = "demo", as_json: JsonOption = False) -> None:
    """Stop the recording and close its file."""
    from endo3d.services.cli.control import command, show

    show(command(rig, "recorder", "stop", {}), as_json)
