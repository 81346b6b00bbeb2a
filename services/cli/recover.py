"""``endo3d recover``: repair a torn log."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def recover(
    logs: Annotated[list[Path], typer.Argument(help="Logs that were not closed.")],
    out: Annotated[
        Path | None, typer.Option("--out", help="Leave the log alone and write what is whole in it here.")
    ] = None,
) -> None:
    """Repair a log that was torn by a crash: everything whole in it is kept and gets an index.

    Example: endo3d recover logs/demo-20260101T120000Z.mcap
    """
    from endo3d.services.archive.recover import recover as repair
    from endo3d.services.runtime.errors import UserError

    if out is not None and len(logs) > 1:
        raise UserError("--out takes one log; recover them one by one")
    for log in logs:
        report = repair(log, out)
        if report.was_whole:
            print(f"{log}: nothing to repair, {report.messages} messages")
            continue
        kept = f"{report.messages} messages in {report.chunks} chunks"
        print(f"{report.path}: {kept}, {report.lost_bytes} bytes lost")
        for damage in report.damages:
            print(f"  byte {damage.offset}: {damage.why}")
        if report.damaged_copy is not None:
            print(f"  the damaged file is {report.damaged_copy}")
