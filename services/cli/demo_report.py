"""The end of a demo: the files, the figures, the table."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import asdict
from itertools import chain
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from endo3d.schemas import topics
from endo3d.schemas.messages import Message
from endo3d.services.archive.reader import Log
from endo3d.services.cli.truth import Comparison, compare
from endo3d.services.exchange.ply import write_ply
from endo3d.services.runtime.errors import UserError
from endo3d.services.views.picture import picture
from endo3d.services.views.recording import write_rrd
from endo3d.services.views.scan import Scan


def write(folder: Path, figures: dict[str, Any]) -> dict[str, Any]:
    """Write map.ply, scan.rrd, picture.png and report.json beside the log; all figures of the run."""
    logs = sorted((Log(path) for path in folder.glob("scan*.mcap")), key=lambda log: log.start_ns)
    if not logs:
        raise UserError(f"the recorder wrote no log into {folder}; see its lines above")
    scan = Scan.of(_messages(logs))
    points = scan.points()
    comparison = compare(scan.poses, scan.truths, points)
    files = {"log": logs[0].path, "map": folder / "map.ply", "recording": folder / "scan.rrd"}
    files["picture"] = folder / "picture.png"
    write_ply(points, files["map"])
    write_rrd(_messages(logs), files["recording"])
    _picture(scan, files["picture"], comparison)
    report = {
        **figures,
        "simulated": scan.simulated,
        "slow_motion": scan.truths[-1].slow_motion if scan.truths else 1.0,
        "frames": sum(log.count(topics.FRAME) for log in logs),
        "rate_hz": (scan.frames - 1) / scan.seconds if scan.seconds else 0.0,
        "missed_triggers": _missed_triggers(scan),
        "poses": len(scan.poses),
        "map_points": len(points),
        "merging_distance_mm": scan.merged.merging_distance_mm,
        "way_mm": scan.length_mm(),
        "against_truth": _against_truth(comparison),
        "files": {name: str(path) for name, path in files.items()},
    }
    (folder / "report.json").write_text(json.dumps(report, indent=2) + "\n")
    return report


def _messages(logs: list[Log]) -> Iterator[Message]:
    """Of all parts: a recorder that was restarted goes on in a new file."""
    return chain.from_iterable(log.messages() for log in logs)


def _missed_triggers(scan: Scan) -> int:
    """Of a simulated camera, from the first pose on: what came before belongs to the start."""
    numbers = [truth.sequence for truth in scan.truths if scan.poses and truth.stamp_ns >= scan.poses[0].stamp_ns]
    return numbers[-1] - numbers[0] + 1 - len(numbers) if numbers else 0


def _picture(scan: Scan, path: Path, comparison: Comparison | None) -> None:
    if comparison is None:
        picture(scan, path, title="endo3d demo")
    else:
        picture(scan, path, colour="deviation", deviation_um=comparison.deviation_um, title="endo3d demo")


def _against_truth(comparison: Comparison | None) -> dict[str, Any] | None:
    if comparison is None:
        return None
    return {
        "trajectory": asdict(comparison.trajectory),
        "lost_share": comparison.lost_share,
        "surface": asdict(comparison.surface),
    }


def show(report: dict[str, Any]) -> None:
    """The table."""
    table = Table(box=box.SIMPLE_HEAD, show_header=False, title="endo3d demo (simulated)", title_justify="left")
    slow = f", in slow motion {report['slow_motion']:.1f}" if report["slow_motion"] > 1 else ""
    table.add_row("first cloud", f"{report['start_s']:.1f} s after the command")
    render = f"; rendering took {report['render_ms']:.0f} ms each at the start" if report["render_ms"] else ""
    table.add_row("frames", f"{report['frames']} at {report['rate_hz']:.1f} Hz{slow}{render}")
    if missed := report["missed_triggers"]:
        share = 100 * missed / (missed + report["frames"])
        table.add_row("missed", f"{missed} triggers ({share:.1f} %): this machine was too busy for the rate")
    table.add_row("lost", _lost(report["lost"]))
    for name, key in (("exposure to cloud", "latency_cloud_ms"), ("exposure to pose", "latency_pose_ms")):
        table.add_row(name, f"p50 {report[key]['p50']:.1f} ms, p99 {report[key]['p99']:.1f} ms")
    merged = f", merged at {1e3 * report['merging_distance_mm']:.0f} um" if report["merging_distance_mm"] else ""
    table.add_row("map", f"{report['map_points']} points{merged}")
    for name, text in _truth_rows(report):
        table.add_row(name, text)
    for name, path in report["files"].items():
        table.add_row(name, path)
    if report["restarts"]:
        table.add_row("restarted", ", ".join(f"{name} {count}x" for name, count in report["restarts"].items()))
    console = Console()
    console.print(table)
    console.print(f"Look at it: [bold]{sys.argv[0]} view {report['files']['log']}[/]", soft_wrap=True)


def _lost(lost: dict[str, dict[str, int]]) -> str:
    hops = (
        f"{name}: " + ", ".join(f"{cause} {count}" for cause, count in causes.items()) for name, causes in lost.items()
    )
    return "\n".join(hops) or "nothing, at any hop"


def _truth_rows(report: dict[str, Any]) -> list[tuple[str, str]]:
    truth = report["against_truth"]
    if truth is None:
        return [("against truth", "not possible: too few poses were tracked")]
    way, surface, length = truth["trajectory"], truth["surface"], f"{report['way_mm']:.1f} mm"
    lost = f", {100 * truth['lost_share']:.1f} % of the poses lost" if truth["lost_share"] else ""
    within = f"95 % within {surface['p95_um']:.1f} um"
    return [
        ("trajectory error", f"rms {way['rms_um']:.1f} um, max {way['max_um']:.1f} um on {length}{lost}"),
        ("surface error", f"rms {surface['rms_um']:.1f} um, mean {surface['mean_um']:+.1f} um, {within}"),
    ]
