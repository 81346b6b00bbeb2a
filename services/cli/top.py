"""``endo3d top``: how the services of a rig do."""

from __future__ import annotations

import json
import threading
import time
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from endo3d.services.cli.options import JsonOption, RigOption

if TYPE_CHECKING:
    from rich.table import Table

    from endo3d.schemas.messages import Message, Status
    from endo3d.services.runtime.bus import Bus

STATUS_WITHIN_S = 3.0
"""Services report about once a second."""
CLOCK = "clock_offset_ms"
"""A relay's value: the rig's clock minus its own host's."""
STATE_STYLES = {"running": "green", "ready": "green", "degraded": "yellow", "failed": "red", "stopped": "dim"}


class Board:
    """The last status of every service of a rig, and who is there."""

    def __init__(self, bus: Bus) -> None:
        from endo3d.schemas import topics

        self.statuses: dict[str, Status] = {}
        self.alive: set[str] = set()
        self.changed = threading.Condition()
        bus.subscribe(topics.STATUS, self._status)
        bus.watch_alive(self._alive)

    def _status(self, message: Message) -> None:
        from endo3d.schemas.messages import Status

        if isinstance(message, Status):
            with self.changed:
                self.statuses[message.service] = message
                self.changed.notify_all()

    def _alive(self, service: str, there: bool) -> None:
        with self.changed:
            (self.alive.add if there else self.alive.discard)(service)
            self.changed.notify_all()

    def wait_for_all(self, timeout_s: float) -> bool:
        """Until somebody is there and everybody who is has reported."""
        with self.changed:
            return self.changed.wait_for(
                lambda: bool(self.alive) and self.alive <= set(self.statuses), timeout_s
            )

    def snapshot(self) -> list[tuple[Status, bool]]:
        """(status, is there), by name."""
        with self.changed:
            return [(status, name in self.alive) for name, status in sorted(self.statuses.items())]


def top(
    rig: RigOption = "demo",
    once: Annotated[bool, typer.Option("--once", help="Print the table once and end.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Live table of the services of all hosts: rate, latency, drops, CPU, memory.

    Latency counts from the exposure of the newest frame involved to the end of the step; on another host, by the
    rig's clock. Below stands how far each host's clock is off, and what its lines carry.

    Examples: endo3d top; endo3d top --once --json
    """
    from rich.console import Console
    from rich.live import Live

    from endo3d.services.cli.control import join
    from endo3d.services.runtime.errors import UserError

    with join(rig) as bus:
        board = Board(bus)
        if once or as_json:
            board.wait_for_all(STATUS_WITHIN_S)
            if not board.snapshot():
                raise UserError(
                    f"no service of rig {bus.rig} is there; start them with endo3d up, or name another --rig"
                )
            _print(board, bus.rig, as_json)
            return
        console = Console()
        with Live(_table(board, bus.rig), console=console, refresh_per_second=2) as live:
            try:
                while True:
                    time.sleep(0.5)
                    live.update(_table(board, bus.rig))
            except KeyboardInterrupt:
                return


def _print(board: Board, rig: str, as_json: bool) -> None:
    from rich import print as show

    if as_json:
        print(
            json.dumps([{**asdict(status), "alive": there} for status, there in board.snapshot()], indent=2)
        )
    else:
        show(_table(board, rig))


def _table(board: Board, rig: str) -> Table:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    rows = board.snapshot()
    ahead_ms = {status.host: status.values.get(CLOCK, 0.0) for status, _ in rows if CLOCK in status.values}
    table = Table(title=f"endo3d/{rig}", box=box.SIMPLE_HEAD, title_justify="left", expand=True)
    several = len({status.host for status, _ in rows}) > 1
    for name in ("host", "service", "state") if several else ("service", "state"):
        table.add_column(name, no_wrap=True)
    for name in ("rate Hz", "p50 ms", "p99 ms", "CPU %", "MB"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("lost, and why it is slow", ratio=1)
    for status, there in rows:
        state = str(status.state) if there else "gone"
        lost = ", ".join(f"{cause} {count}" for cause, count in status.dropped.items() if count)
        late_ms = ahead_ms.get(status.host, 0.0)
        table.add_row(
            *([status.host] if several else []),
            status.service,
            Text(state, STATE_STYLES.get(state, "red")),
            f"{status.rate_hz:.1f}",
            f"{status.latency_p50_ms + late_ms:.1f}",
            f"{status.latency_p99_ms + late_ms:.1f}",
            f"{100 * status.cpu_share:.0f}",
            f"{status.memory_mb:.0f}",
            "\n".join(filter(None, (lost, status.note))) or "-",
        )
    table.caption = "\n".join(filter(None, (_links(status) for status, _ in rows)))
    if not board.statuses:
        table.caption = "nobody is there yet; Ctrl-C ends"
    return table


def _links(status: Status) -> str:
    """What a relay knows of its host's clock and lines; empty of any other service."""
    parts = []
    if CLOCK in status.values:
        parts.append(f"clock {-status.values[CLOCK]:+.2f} ms (+-{status.values['round_trip_ms'] / 2:.2f} ms)")
    for name, value in status.values.items():
        if name.startswith("mbit_s to "):
            parts.append(f"{value:.1f} Mbit/s {name.removeprefix('mbit_s ')}")
    return f"{status.host}: {', '.join(parts)}" if parts else ""
