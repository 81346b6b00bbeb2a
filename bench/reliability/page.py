"""docs/reliability.md: each program replaces its own section of the page, and leaves the rest alone."""

from __future__ import annotations

import platform
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from bench.run import machine


def write_faults(
    page: Path, outcomes: Sequence[Mapping[str, Any]], verdict: Mapping[str, Any] | None, left_out: str
) -> None:
    """The table of the fault campaign."""
    _replace(page, "faults", _faults(outcomes, verdict, left_out))


def write_soak(page: Path, head: str, rows: Sequence[Sequence[str]], columns: Sequence[str], tail: str) -> None:
    """The table of a long run."""
    _replace(page, "soak", [head, "", *_table(columns, rows), "", tail])


def _faults(
    outcomes: Sequence[Mapping[str, Any]], verdict: Mapping[str, Any] | None, left_out: str
) -> Iterator[str]:
    yield f"`make faults` on {where()}; one simulated scan, every fault in turn."
    yield ""
    columns = ("fault", "recovery / s", "what said so, first", "lost, counted", "wrong poses", "worst pose / um")
    yield from _table(columns, [_row(outcome) for outcome in outcomes])
    if left_out:
        yield ""
        yield f"Left out: full disk and full /dev/shm ({left_out})."
    if verdict:
        yield ""
        yield (
            f"Of its log, {verdict['logs']} copies were damaged (bits turned over, a piece zeroed, the end cut off): "
            f"{verdict['refused']} were refused in one line as they were; after `endo3d recover` "
            f"{verdict['repaired']} were whole again, with {verdict['messages']} messages, of which "
            f"{verdict['misread']} differ from what was recorded; {verdict['beyond_repair']} were beyond repair, "
            f"and said so; {verdict['tracebacks']} tracebacks."
        )


def _row(outcome: Mapping[str, Any]) -> list[str]:
    lost = ", ".join(f"{cause} {count}" for cause, count in outcome["lost"].items()) or "nothing"
    recovery = f"**hung**: {outcome['hung']}" if outcome["hung"] else f"{outcome['recovery_s']:.1f}"
    state = outcome["state"] or "**nothing**"
    return [outcome["fault"], recovery, state, lost, str(outcome["wrong_poses"]), f"{outcome['worst_um']:.0f}"]


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    yield f"| {' | '.join(columns)} |"
    yield f"|{'---|' * len(columns)}"
    for row in rows:
        yield f"| {' | '.join(cell.replace('|', '/') for cell in row)} |"


def where() -> str:
    """This machine, without its name, and the date."""
    _, _, hardware = machine().partition(": ")  # the name of the host is nobody's business
    return f"{hardware}, Python {platform.python_version()}, {datetime.now(UTC):%Y-%m-%d}"


def _replace(page: Path, section: str, lines: Iterator[str] | Sequence[str]) -> None:
    """Between ``<!-- section -->`` and ``<!-- end section -->``; raises ``ValueError`` for a page without them."""
    text = page.read_text(encoding="utf-8")
    before, begin, rest = text.partition(f"<!-- {section} -->\n")
    _, end, after = rest.partition(f"<!-- end {section} -->")
    if not begin or not end:
        raise ValueError(f"{page} has no place for {section}")
    page.write_text(before + begin + "\n" + "\n".join(lines) + "\n\n" + end + after, encoding="utf-8")
