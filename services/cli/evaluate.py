"""``endo3d evaluate``: the paper's experiments on the virtual rig."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from endo3d.services.evaluation.measure import Settings

EXPERIMENTS = ("decode", "spheres", "cylinder", "handheld")


def evaluate(
    experiment: Annotated[str, typer.Argument(help="decode, spheres, cylinder, handheld, or all.")],
    quick: Annotated[bool, typer.Option("--quick", help="A small version, in seconds; not the paper's.")] = False,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for reports, plots and the cache.")] = Path(
        "evaluation"
    ),
    page: Annotated[
        Path | None, typer.Option("--page", help="Write all reports of the folder as one page too.")
    ] = None,
    frames: Annotated[
        Path | None, typer.Option("--frames", help="Keep the rendered frames there: measuring again is quick.")
    ] = None,
    threads: Annotated[int, typer.Option(min=1, help="Threads that render.")] = os.cpu_count() or 1,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures instead of the tables.")] = False,
) -> None:
    """Repeat the paper's experiments: table beside the paper's figures, plots, JSON, HTML.

    Simulated frames go through the decoder's and the odometry's own steps. An interrupted run goes on where it
    stopped. Examples: endo3d evaluate spheres --quick; endo3d evaluate all --page docs/evaluation.md
    """
    from endo3d.services.evaluation.measure import Settings
    from endo3d.services.runtime.errors import UserError

    if experiment not in (*EXPERIMENTS, "all"):
        raise UserError(f"no experiment {experiment!r}; there are: {', '.join(EXPERIMENTS)}, all")
    out.mkdir(parents=True, exist_ok=True)
    for name in EXPERIMENTS if experiment == "all" else (experiment,):
        _run(name, Settings(out, quick, threads, frames), as_json)
    if page is not None:
        _write(page, out)


def _run(name: str, settings: Settings, as_json: bool) -> None:
    import importlib
    import json
    from dataclasses import replace

    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from endo3d.services.evaluation.report import SIMULATED

    module = importlib.import_module(f"endo3d.services.evaluation.{name}")
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(f"{name} ({SIMULATED})", total=module.steps(settings.quick))
        watched = replace(settings, progress=lambda done: bar.update(task, completed=done))
        report = module.evaluate(watched)
    report.save(settings.folder)
    if as_json:
        print(json.dumps({"simulated": True, **report.figures}))
    else:
        _print(report)
        print(f"written: {settings.folder / report.name}.html, .json, .png")


def _print(report: object) -> None:
    from rich.console import Console
    from rich.table import Table

    from endo3d.services.evaluation.report import SIMULATED, Report

    assert isinstance(report, Report)
    console = Console()
    for table in report.tables:
        shown = Table(title=f"{table.title}\n{SIMULATED}", title_justify="left")
        for column in table.columns:
            shown.add_column(column)
        for row in table.rows:
            shown.add_row(*row)
        console.print(shown)


def _write(page: Path, out: Path) -> None:
    """The reports of the full-size runs that the folder holds, as a page beside its plots."""
    import shutil

    from endo3d.services.evaluation import report

    kept = [report.load(out / f"{name}.json") for name in EXPERIMENTS if (out / f"{name}.json").exists()]
    images = page.parent / page.stem
    images.mkdir(parents=True, exist_ok=True)
    for one in kept:
        for plot in one.plots:
            shutil.copy(out / plot, images / plot)
    page.write_text(report.page(kept, f"{page.stem}/"), encoding="utf-8")
