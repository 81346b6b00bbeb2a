"""``make soak MINUTES=30``: the whole stack at 172 Hz for a long time, minute by minute.

Prerendered 1920 x 1200 frames go round and round; each turn begins a new scan. Raw frames at that rate are
24 GB a minute, so that the recorder keeps some of them; everything else is as in ``python -m bench.stack``.

    python -m bench.reliability.soak --minutes 30 --page docs/reliability.md

Goals: flat memory, no unexplained drop: what the player sent, and a service neither got nor counted as lost.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import Progress

from bench import stack as frames
from bench.reliability import page
from bench.reliability.scan import Scan
from bench.reliability.witness import Record
from endo3d.schemas.messages import Status

COLUMNS = (
    "minute", "frames", "clouds", "poses", "lost, counted", "cloud p50 / p99 ms", "pose p50 / p99 ms",
    "lost poses", "memory of all / MB", "CPU of all / %",
)  # fmt: skip
SETTLED_MINUTES = 2
"""Caches and queues grow until then."""


@dataclass(frozen=True)
class Minute:
    """What a minute was like."""

    number: int
    frames: int
    seen: Record
    lost: int
    memory_mb: float
    cpu_percent: float

    def row(self) -> list[str]:
        cloud, pose = (_percentiles(ms) for ms in (self.seen.cloud_latency_ms, self.seen.pose_latency_ms))
        return [
            str(self.number), str(self.frames), str(self.seen.clouds), str(self.seen.poses), str(self.lost),
            cloud, pose, str(self.seen.tracking["lost"]), f"{self.memory_mb:.0f}",
            f"{self.cpu_percent:.0f}",
        ]  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--minutes", type=int, default=30)
    parser.add_argument("--rate", type=float, default=1.0, help="times the recorded 172 Hz")
    parser.add_argument("--page", type=Path, help="write the table into this Markdown page")
    asked = parser.parse_args()
    log = frames.prerendered()
    with tempfile.TemporaryDirectory(dir=log.parent) as folder:
        overrides = [
            f"rig.name=soak{os.getpid()}",
            f"player.log={log.resolve()}",
            "player.loop=true",
            f"player.rate={asked.rate}",
            f"recorder.directory={folder}",
            "recorder.log_hz={frame = 1, depth = 1}",
            "viewer.port=0",
            "viewer.web_port=0",
        ]
        minutes, unexplained = soak(overrides, asked.minutes)
    growth_mb = growth(minutes)
    lost, sent = sum(minute.lost for minute in minutes), sum(minute.frames for minute in minutes)
    tail = (
        f"Memory from minute {SETTLED_MINUTES} on: {growth_mb:+.2f} MB per minute. Of {sent} frames {lost} samples "
        f"were lost on the way to somebody, all counted; unexplained: {unexplained}."
    )
    print(tail)
    if asked.page:
        rate_hz = frames.RATE_HZ * asked.rate
        head = f"`make soak MINUTES={asked.minutes}`, {rate_hz:g} Hz, 1920 x 1200, simulated, on {page.where()}."
        page.write_soak(asked.page, head, [minute.row() for minute in minutes], COLUMNS, tail)
    return int(unexplained != 0)


def soak(overrides: Sequence[str], count: int) -> tuple[list[Minute], int]:
    """Run the stack of a player for ``count`` minutes.

    Also: frames that the player sent and the decoder neither got nor counted as lost, from start to end.
    """
    console = Console(stderr=True)
    minutes: list[Minute] = []
    with Progress(console=console, transient=True) as progress, Scan("player", overrides) as scan:
        task = progress.add_task("soak", total=60 * count)
        before = dict(scan.witness.statuses)
        scan.listen()
        for number in range(1, count + 1):
            end_s = time.monotonic() + 60.0
            while (left_s := end_s - time.monotonic()) > 0:
                scan.turn_for(min(1.0, left_s))
                progress.advance(task)
            now = dict(scan.witness.statuses)
            minutes.append(_minute(number, before, now, scan.witness.take()))
            if sum(child.total_restarts for child in scan.launcher.children):
                raise SystemExit(f"a service was restarted: {'; '.join(scan.said[-5:])}")
            console.print("  ".join(f"{title} {cell}" for title, cell in zip(COLUMNS, minutes[-1].row(), strict=True)))
            before = now
        scan.launcher.stop()  # with its last words everybody says the final counts
        return minutes, unexplained(scan.witness.statuses)


def growth(minutes: Sequence[Minute]) -> float:
    """MB per minute, from when everything has settled: the slope of a straight line."""
    settled = [(minute.number, minute.memory_mb) for minute in minutes if minute.number > SETTLED_MINUTES]
    if len(settled) < 3:
        return float("nan")
    numbers, memory_mb = np.array(settled).T
    return float(np.polyfit(numbers, memory_mb, 1)[0])


def unexplained(statuses: Mapping[str, Status]) -> int:
    """What the player sent and the decoder neither got nor counted."""
    sent, decoder = statuses["player"].published["frame"], statuses["decoder"]
    return sent - decoder.received["frame"] - decoder.dropped.get("frame:missed", 0)


def _minute(number: int, before: dict[str, Status], now: dict[str, Status], seen: Record) -> Minute:
    sent = now["player"].published["frame"] - before["player"].published["frame"]
    lost = sum(sum(status.dropped.values()) - sum(before[name].dropped.values()) for name, status in now.items())
    memory_mb = sum(status.memory_mb for status in now.values())
    return Minute(number, sent, seen, lost, memory_mb, 100.0 * sum(status.cpu_share for status in now.values()))


def _percentiles(latencies_ms: Sequence[float]) -> str:
    if not latencies_ms:
        return "-"
    p50, p99 = np.percentile(latencies_ms, (50, 99))
    return f"{p50:.1f} / {p99:.1f}"


if __name__ == "__main__":
    sys.exit(main())
