"""``endo3d demo``: the whole stack on the virtual rig, and what came of it."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from endo3d.services.cli.options import JsonOption, SetOption

if TYPE_CHECKING:
    from rich.progress import Progress

    from endo3d.services.cli.pace import Pace
    from endo3d.services.cli.up import Asked
    from endo3d.services.cli.watch import Watch
    from endo3d.services.runtime.launcher import Launcher
    from endo3d.services.runtime.stack_file import Stack

PATIENCE_S = 8.0
"""A start that takes longer is explained, and so often again where nothing can be drawn."""
START_LIMIT_S = 300.0
"""Compiling every kernel for the first time takes a while."""
TRIAL_S = 3.0
MISSED_MAX = 0.03
"""A scan that misses more of its triggers in its first seconds begins again at a slower rate."""


class TooFast(Exception):
    """This machine can't hold the rate."""

    def __init__(self, missed_share: float) -> None:
        super().__init__(f"{100 * missed_share:.0f} % of the triggers were missed")


def demo(
    seconds: Annotated[float, typer.Option("--seconds", min=1.0, help="How long to scan.")] = 30.0,
    out: Annotated[Path | None, typer.Option("--out", help="Folder for the files; default out/demo-<time>.")] = None,
    stack: Annotated[str, typer.Option("--stack", help="Another stack than the stock one.")] = "demo",
    overrides: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Scan the micro-contour standard on the virtual rig, and compare with the truth.

    Starts every service as a process of its own: projector sequence, camera, decoder, odometry, recorder,
    viewer. A hand-guided scan is rendered live, as fast as this machine can, so in slow motion. At the end: a
    table, a log, the merged cloud, a Rerun recording and a picture.

    Examples: endo3d demo; endo3d demo --seconds 60 --out scan; endo3d demo --json
    """
    from endo3d.services.cli.demo_report import show, write

    folder = out or Path("out") / f"demo-{datetime.now(UTC):%Y%m%d-%H%M%S}"
    folder.mkdir(parents=True, exist_ok=True)
    settings = [*_recording(folder), *(overrides or ())]
    figures = _scan_at_its_pace(folder, stack, settings, seconds, as_json)
    report = write(folder, figures)
    if as_json:
        print(json.dumps(report, indent=2))
    else:
        show(report)
    raise typer.Exit(report["exit_code"])


def _recording(folder: Path) -> list[str]:
    return [f"recorder.directory={folder.resolve()}", "recorder.name=scan", "recorder.autostart=true"]


def _pace(stack: str, settings: list[str]) -> Pace | None:
    """What makes the demo fit this machine; None when somebody has chosen a rate or a camera."""
    from endo3d.services.cli.pace import measure
    from endo3d.services.runtime import stack_file

    if any(setting.startswith(("sequencer.rate_hz=", "grabber.camera=")) for setting in settings):
        return None
    return measure(stack_file.load(stack, settings))


def _scan_at_its_pace(folder: Path, stack: str, settings: list[str], seconds: float, quiet: bool) -> dict[str, Any]:
    """``scan`` at the fastest rate that this machine holds."""
    before = set(folder.iterdir())
    pace = _pace(stack, settings)
    if pace is None:
        return {**scan(stack, settings, seconds, quiet), "render_ms": None}
    if not quiet:
        print(pace.describe(), file=sys.stderr)
    while (slower := pace.slower()) is not None:
        try:
            figures = scan(stack, [*pace.overrides(), *settings], seconds, quiet, on_trial=True)
            return {**figures, "render_ms": pace.render_ms}
        except TooFast as too_fast:
            for file in set(folder.iterdir()) - before:
                file.unlink()
            pace = slower
            if not quiet:
                print(f"{too_fast}: once more, at {pace.rate_hz:g} Hz.", file=sys.stderr)
    return {**scan(stack, [*pace.overrides(), *settings], seconds, quiet), "render_ms": pace.render_ms}


def scan(stack: str, overrides: list[str], seconds: float, quiet: bool, *, on_trial: bool = False) -> dict[str, Any]:
    """Run the stack for ``seconds`` from its first pose on; what was measured while it ran.

    ``on_trial``: raises ``TooFast`` when its first seconds miss too many triggers.
    """
    from endo3d.services.cli.up import Asked
    from endo3d.services.cli.watch import Watch, percentiles_ms
    from endo3d.services.runtime import graph, stack_file
    from endo3d.services.runtime.bus import Bus
    from endo3d.services.runtime.errors import UserError
    from endo3d.services.runtime.launcher import Launcher, children_of

    began_s = time.monotonic()
    described = stack_file.load(stack, overrides)
    graph.of(described)
    asked, lines = Asked(), Lines()
    with Bus.open(described.rig.name, name="demo", port=described.rig.port) as bus:
        if there := bus.alive():
            names = ", ".join(sorted(there))
            raise UserError(f"rig {bus.rig} runs already ({names}); end it, or --set rig.name=another")
        watch = Watch(bus)
        with Launcher(children_of(described, overrides), lines) as launcher, _progress(quiet) as progress:
            lines.progress = progress
            launcher.start()
            _await_first_results(launcher, watch, asked, described, progress, began_s)
            scanned_s = _scan(launcher, watch, asked, progress, seconds, on_trial)
            progress.update(progress.add_task("closing the archive", total=None))
            launcher.stop(hurry=lambda: asked.times > 1)
        if launcher.user_error:
            raise UserError(launcher.user_error)
        return {
            "rig": bus.rig,
            "stack": described.label,
            "start_s": watch.first_cloud_s - began_s,
            "scan_s": scanned_s,
            "latency_cloud_ms": percentiles_ms(watch.cloud_latency_ms),
            "latency_pose_ms": percentiles_ms(watch.pose_latency_ms),
            "clouds": watch.clouds,
            "lost": watch.lost(),
            "services": watch.loads(),
            "restarts": {child.name: child.total_restarts for child in launcher.children if child.total_restarts},
            "exit_code": launcher.exit_code,
        }


class Lines:
    """Shows what the services say above the progress bar: what matters, unless somebody wants all of it."""

    def __init__(self) -> None:
        self.progress: Progress | None = None

    def __call__(self, service: str, line: str) -> None:
        from rich.text import Text

        if self.progress is not None and not line.startswith("DEBUG") and line != "INFO ready":
            self.progress.console.print(Text.assemble((f"{service:<10} │ ", "cyan"), line), soft_wrap=True)


@contextmanager
def _progress(quiet: bool) -> Iterator[Progress]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(24), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), disable=quiet, transient=True) as progress:
        yield progress


def _await_first_results(
    launcher: Launcher, watch: Watch, asked: Asked, stack: Stack, progress: Progress, began_s: float
) -> None:
    """Until odometry has its first pose: a camera that runs before that scans in vain."""
    from endo3d.schemas import topics

    names = list(stack.tables)
    posed = any(topics.POSE in stack.kind(name).writes for name in names)
    task = progress.add_task("starting", total=len(names))
    say_at_s = time.monotonic() + PATIENCE_S
    while not (watch.poses if posed else watch.clouds) and not (launcher.done or asked.times):
        missing, spent_s = watch.starting(names), time.monotonic() - began_s
        what = f"starting {', '.join(missing)}" if missing else "waiting for the first results"
        what += ": compiling their kernels, the first time only" if missing and spent_s > PATIENCE_S else ""
        progress.update(task, completed=len(names) - len(missing), description=what)
        if time.monotonic() > say_at_s and not progress.console.is_terminal and not progress.disable:
            progress.console.print(f"{spent_s:.0f} s: {what}", soft_wrap=True)
            say_at_s += PATIENCE_S
        _turn_or_give_up(launcher, began_s)
    progress.remove_task(task)


def _turn_or_give_up(launcher: Launcher, began_s: float) -> None:
    from endo3d.services.runtime.errors import UserError
    from endo3d.services.runtime.launcher import State

    launcher.turn(0.05)
    if fallen := [child.name for child in launcher.children if child.state is State.GIVEN_UP]:
        raise UserError(launcher.user_error or f"{', '.join(fallen)} keeps crashing; its lines above say why")
    if time.monotonic() - began_s > START_LIMIT_S:
        raise UserError(f"no results after {START_LIMIT_S:.0f} s; endo3d doctor checks this machine")


def _scan(launcher: Launcher, watch: Watch, asked: Asked, progress: Progress, seconds: float, on_trial: bool) -> float:
    """Until the time is over, somebody asks, or the stack is done; seconds scanned. Raises ``TooFast``."""
    task = progress.add_task("scanning", total=seconds)
    began_s, before = time.monotonic(), watch.triggers("grabber")
    while (spent_s := time.monotonic() - began_s) < seconds and not (launcher.done or asked.times):
        launcher.turn(0.1)
        what = f"scanning: {watch.clouds} clouds at {watch.rate_hz('decoder'):.0f} Hz, {watch.tracking}"
        progress.update(task, completed=spent_s, description=what)
        if on_trial and spent_s > TRIAL_S:
            on_trial = False
            if (missed_share := watch.triggers("grabber").missed_share(before)) > MISSED_MAX:
                launcher.stop(hurry=lambda: asked.times > 0)
                raise TooFast(missed_share)
    progress.remove_task(task)
    return spent_s
