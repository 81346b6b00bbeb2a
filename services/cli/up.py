"""``endo3d up``: every service of a stack, kept running."""

from __future__ import annotations

import signal
from contextlib import suppress
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated

import typer

from endo3d.services.cli.options import HostOption, SetOption, StackArgument

if TYPE_CHECKING:
    from collections.abc import Callable

COLOURS = ("cyan", "green", "magenta", "yellow", "blue", "bright_red", "bright_cyan", "bright_green")


class LogFormat(StrEnum):
    TEXT = "text"
    JSON = "json"


def up(
    stack: StackArgument,
    overrides: SetOption = None,
    host: HostOption = "",
    log: Annotated[LogFormat, typer.Option("--log", help="For people, or a JSON object per event.")] = LogFormat.TEXT,
    seconds: Annotated[float, typer.Option("--seconds", help="Stop after that long; 0 runs on.")] = 0.0,
) -> None:
    """Start every service of a stack file, and keep them running.

    A crashed service is restarted, first after 0.2 s. Ctrl-C stops all, sources first, so that the archive is
    closed; a second Ctrl-C kills what has not stopped yet. Of a stack with several hosts, the services of this one.

    Examples: endo3d up demo; endo3d up my.toml --set recorder.directory=/data; endo3d up two.toml --host rig
    """
    from endo3d.services.runtime import graph, stack_file
    from endo3d.services.runtime.errors import UserError
    from endo3d.services.runtime.launcher import Launcher, children_of
    from endo3d.services.runtime.log import FORMAT_VARIABLE
    from endo3d.services.runtime.notify import Notifier

    described = stack_file.load(stack, overrides or ()).on(host)
    graph.of(described)
    asked, systemd = Asked(), Notifier()
    names = list(described.share().values())
    sink = json_printer(host) if log is LogFormat.JSON else log_printer(names)
    with Launcher(children_of(described, overrides or ()), sink, {FORMAT_VARIABLE: str(log)}) as launcher:
        launcher.start()
        systemd.ready(f"started {', '.join(names)}")
        while not (launcher.done or asked.times or (seconds and asked.after(seconds))):
            launcher.turn()
            systemd.alive()
        systemd.stopping()
        launcher.stop(hurry=lambda: asked.times > 1)
    if launcher.user_error:
        raise UserError(launcher.user_error)
    raise typer.Exit(launcher.exit_code)


def json_printer(host: str) -> Callable[[str, str], None]:
    """Prints (service, line) as a JSON object a line; what is no event, e.g. the launcher's words, becomes one."""
    import json
    import sys

    def show(service: str, line: str) -> None:
        event: object = None
        with suppress(ValueError):
            event = json.loads(line)
        where = {"host": host, "service": service} if host else {"service": service}
        print(json.dumps({**where, **(event if isinstance(event, dict) else {"message": line})}), file=sys.stderr)

    return show


class Asked:
    """Counts how often somebody asked us to stop: Ctrl-C or SIGTERM."""

    def __init__(self) -> None:
        import time

        self.times = 0
        self.clock = time.monotonic
        self.began_s = self.clock()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._count)

    def _count(self, *_: object) -> None:
        self.times += 1

    def after(self, seconds: float) -> bool:
        return self.clock() - self.began_s > seconds


def log_printer(services: list[str]) -> Callable[[str, str], None]:
    """Prints (service, line) with the service's name in its own colour; plain where there is no terminal."""
    from rich.console import Console
    from rich.text import Text

    console = Console(stderr=True, soft_wrap=True, highlight=False)
    width = max(map(len, services), default=0)
    styles = {name: COLOURS[index % len(COLOURS)] for index, name in enumerate(services)}

    def show(service: str, line: str) -> None:
        console.print(Text.assemble((f"{service:<{width}} │ ", styles.get(service, "bold")), line))

    return show
