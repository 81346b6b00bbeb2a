"""``endo3d run``: one service of a stack, in this process."""

from __future__ import annotations

from typing import Annotated

import typer

from endo3d.services.cli.options import HostOption, SetOption, StackOption


def run(
    service: Annotated[str, typer.Argument(help="The service's table in the stack file.")],
    stack: StackOption = "demo",
    overrides: SetOption = None,
    host: HostOption = "",
) -> None:
    """Run one service of a stack in this process.

    The launcher does this for every service; by hand it serves for debugging, or to spread a stack over
    terminals. Services may be started in any order.

    Example: endo3d run decoder --stack demo --set decoder.form=three
    """
    import os

    from endo3d.services.runtime import priority
    from endo3d.services.runtime.launcher import follow_parent

    follow_parent()
    priority.settle(int(os.environ.get("ENDO3D_NICE", "0")))

    import logging

    from endo3d.services.runtime import runner, stack_file
    from endo3d.services.runtime.errors import UserError

    described = stack_file.load(stack, overrides or ()).on(host)
    built = described.entry(service).build()
    try:
        name = described.share().get(service, service)
        code = runner.run(built, rig=described.rig.name, name=name, port=described.rig.port, host=host)
    except UserError:
        raise
    except Exception:
        logging.getLogger(service).exception("ends: this should not have happened")
        code = 1
    raise typer.Exit(code)
