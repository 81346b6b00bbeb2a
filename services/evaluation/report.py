"""What an experiment hands in: tables beside the paper's figures, plots, and what they were made with."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

SIMULATED = "simulated (virtual rig, no hardware)"


@dataclass(frozen=True)
class Table:
    title: str
    columns: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]


@dataclass(frozen=True)
class Report:
    """One experiment."""

    name: str
    title: str
    about: list[str]
    """Paragraphs: what was done, with what."""
    tables: list[Table]
    plots: list[str]
    """File names beside the report."""
    figures: dict[str, Any] = field(default_factory=dict)
    """Everything that was measured, machine-readable."""

    def save(self, folder: Path) -> None:
        """``<name>.json`` and ``<name>.html``, beside the plots."""
        text = json.dumps({"simulated": True, **asdict(self)}, indent=1)
        (folder / f"{self.name}.json").write_text(text, encoding="utf-8")
        (folder / f"{self.name}.html").write_text(self.html(), encoding="utf-8")

    def markdown(self, images: str = "") -> str:
        """A section of a document; ``images`` is the folder of the plots as seen from it."""
        lines = [f"## {self.title}", ""]
        for paragraph in self.about:
            lines += [paragraph, ""]
        for table in self.tables:
            lines += [
                f"**{table.title}** ({SIMULATED})",
                "",
                _row(table.columns),
                _row(("---",) * len(table.columns)),
            ]
            lines += [*(_row(row) for row in table.rows), ""]
        for plot in self.plots:
            lines += [f"![{self.title}, {SIMULATED}]({images}{plot})", ""]
        return "\n".join(lines)

    def html(self) -> str:
        """One page."""
        e = html.escape
        parts = [f"<h1>{e(self.title)}</h1>", f"<p><b>{SIMULATED}</b></p>"]
        parts += [f"<p>{e(paragraph)}</p>" for paragraph in self.about]
        for table in self.tables:
            head = "".join(f"<th>{e(column)}</th>" for column in table.columns)
            rows = "".join("<tr>" + "".join(f"<td>{e(cell)}</td>" for cell in row) + "</tr>" for row in table.rows)
            parts.append(f"<h2>{e(table.title)}</h2><table><tr>{head}</tr>{rows}</table>")
        parts += [f'<img src="{e(plot)}" alt="{e(self.title)}">' for plot in self.plots]
        style = (
            "body{font:15px/1.5 sans-serif;max-width:60em;margin:2em auto;padding:0 1em}"
            "table{border-collapse:collapse}td,th{border:1px solid #ccc;padding:.2em .6em;text-align:right}"
            "td:first-child,th:first-child{text-align:left}img{max-width:100%}"
        )
        return (
            f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{e(self.title)}</title>'
            f"<style>{style}</style><body>{''.join(parts)}</body></html>\n"
        )


def load(path: Path) -> Report:
    """A report that was saved as JSON."""
    kept = json.loads(path.read_text(encoding="utf-8"))
    kept.pop("simulated")
    kept["tables"] = [Table(t["title"], tuple(t["columns"]), [tuple(row) for row in t["rows"]]) for t in kept["tables"]]
    return Report(**kept)


def page(reports: list[Report], images: str) -> str:
    """docs/evaluation.md: written by the program, not by hand."""
    head = [
        "# Evaluation",
        "",
        f"The paper's experiments, {SIMULATED}: no figure on this page was measured with an instrument.",
        "This page is written by `endo3d evaluate`; change the program, not the page.",
        "",
    ]
    return "\n".join(head) + "\n".join(report.markdown(images) for report in reports)


def _row(cells: tuple[str, ...]) -> str:
    return "| " + " | ".join(cells) + " |"
