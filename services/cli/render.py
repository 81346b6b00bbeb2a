"""``endo3d render``: frames of a scene into a log, to be played as if they came from the camera."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer


def render(
    scene: Annotated[str, typer.Argument(help="A scene as text, e.g. 'contour texture=noise:0.15:0.15'.")],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="LOG", help="The log (.mcap) to write.")],
    head: Annotated[str, typer.Option(help="A stock head's name, or a head's file (.yaml).")] = "base6_wd20",
    motion: Annotated[str, typer.Option(help="still, 'stage v=2 along=x', 'hand seed=7'.")] = "hand seed=7",
    patterns: Annotated[str, typer.Option(help="The pattern set as text.")] = "interleaved f1=15",
    rate_hz: Annotated[float, typer.Option("--rate", min=1.0, max=250.0, help="Patterns per second.")] = 172.0,
    seconds: Annotated[float, typer.Option(min=0.0, help="Duration.")] = 26.0,
    preset: Annotated[str, typer.Option(help="Image formation: full, fast, ideal.")] = "full",
    bin_px: Annotated[int, typer.Option("--bin", min=1, max=8, help="Camera pixels per pixel.")] = 1,
    seed: Annotated[int, typer.Option(help="Of the noise.")] = 0,
    threads: Annotated[int, typer.Option(min=1, help="Threads that render.")] = os.cpu_count() or 1,
) -> None:
    """Render frames of a scene into a log, with their truth.

    An interrupted rendering goes on where it stopped, when the same command is given again. Play the log with
    the player: it takes the camera's place at any rate.

    Example: endo3d render "sphere r=1 at=0,0,20 surface=metal" --motion still --seconds 1 -o sphere.mcap
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from endo3d.services.evaluation.prerender import prerender
    from endo3d.services.evaluation.virtual_run import VirtualRun
    from endo3d.services.runtime.errors import UserError
    from endo3d_core.virtual_rig.effects import PRESETS

    if preset not in PRESETS:
        raise UserError(f"no preset {preset!r}; there are: {', '.join(PRESETS)}")
    frames = max(1, round(seconds * rate_hz))
    try:
        run = VirtualRun(_head(head), scene, motion, patterns, rate_hz, frames, seed, PRESETS[preset], bin_px)
        run.check()
    except ValueError as error:
        raise UserError(str(error)) from error
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("rendering (simulated)", total=frames)
        prerender(run, out, threads, lambda done: bar.update(task, completed=done))
    print(f"{out}: {frames} simulated frames, {out.stat().st_size / 1e6:.0f} MB")


def _head(name: str) -> str:
    """The text of a head's file."""
    from endo3d.services.runtime.errors import UserError
    from endo3d.services.runtime.stack_file import stock

    known = stock("heads")
    path = known.get(name, Path(name))
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise UserError(f"head {name!r}: {error.strerror}; stock heads: {', '.join(known)}") from error
