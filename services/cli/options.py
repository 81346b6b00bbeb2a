"""Options that several commands share."""

from __future__ import annotations

from typing import Annotated

import typer


def complete_stack(incomplete: str) -> list[str]:
    from endo3d.services.runtime.stack_file import stock

    return [name for name in stock("stacks") if name.startswith(incomplete)]


StackArgument = Annotated[
    str,
    typer.Argument(
        metavar="STACK", help="A stack file, or a stock stack's name.", autocompletion=complete_stack
    ),
]
StackOption = Annotated[
    str,
    typer.Option(
        "--stack",
        metavar="STACK",
        help="A stack file, or a stock stack's name.",
        autocompletion=complete_stack,
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="TABLE.KEY=VALUE", help="Override one key of the stack file; repeatable."),
]
RigOption = Annotated[
    str,
    typer.Option(
        "--rig", envvar="ENDO3D_RIG", help="The rig's name as in its stack file, or the file (.toml)."
    ),
]
HostOption = Annotated[
    str,
    typer.Option("--host", envvar="ENDO3D_HOST", help="Which of the stack's hosts this one is: [hosts.NAME]."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Machine-readable output.")]
