"""Plots of one make: for the documents, the benches and the picture of a scan.

with figure("Depth uncertainty", simulated=True, path="docs/sigma.svg") as fig:
    axes = fig.subplots()
    axes.plot(depth_mm, sigma_um, color=COLOURS[0], label="predicted")
    axes.set(xlabel="depth / mm", ylabel="sigma / um")
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from cycler import cycler
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from endo3d.services.views.colour import TABLES

COLOURS = ("#2c6fa6", "#d8663f", "#3fbf86", "#8c5fb0", "#d9a92e", "#6b7078")
"""Blue, orange, green, violet, ochre, grey: told apart by the colour-blind in this order."""

RAMPS = {name: LinearSegmentedColormap.from_list(name, rgb / 255.0) for name, rgb in TABLES.items()}
"""The ramps of the views as matplotlib colour maps: height, quality, deviation."""

INK, PAPER, FAINT = "#22262c", "#ffffff", "#c9cdd3"
NIGHT_INK, NIGHT_PAPER, NIGHT_FAINT = "#e4e6ea", "#101115", "#3a3e46"


@contextmanager
def house_style(night: bool = False) -> Iterator[None]:
    """matplotlib's settings while it lasts: light for documents, dark beside a rendered cloud."""
    ink, paper, faint = (NIGHT_INK, NIGHT_PAPER, NIGHT_FAINT) if night else (INK, PAPER, FAINT)
    rules: Any = {
        "figure.facecolor": paper,
        "figure.dpi": 150,
        "figure.constrained_layout.use": not night,
        "axes.facecolor": paper,
        "axes.edgecolor": faint,
        "axes.labelcolor": ink,
        "axes.titlecolor": ink,
        "axes.titlesize": 9.5,
        "axes.titlelocation": "left",
        "axes.labelsize": 8.5,
        "axes.grid": True,
        "axes.axisbelow": True,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.prop_cycle": cycler(color=list(COLOURS)),
        "grid.color": faint,
        "grid.linewidth": 0.5,
        "grid.alpha": 0.6,
        "lines.linewidth": 1.3,
        "xtick.color": ink,
        "ytick.color": ink,
        "xtick.labelsize": 7.5,
        "ytick.labelsize": 7.5,
        "text.color": ink,
        "font.size": 8.5,
        "legend.frameon": False,
        "legend.fontsize": 7.5,
        "svg.hashsalt": "endo3d",
    }
    with matplotlib.rc_context(rules):
        yield


@contextmanager
def figure(
    title: str, *, simulated: bool, path: str | Path, size_in: tuple[float, float] = (6.4, 3.6)
) -> Iterator[Figure]:
    """A figure in the house style, saved at ``path`` (png, svg, pdf) on leaving; marked when simulated."""
    with house_style():
        fig = Figure(figsize=size_in)
        fig.suptitle(title, x=0.01, ha="left", fontsize=11, fontweight="bold")
        yield fig
        if simulated:
            watermark(fig)
        fig.savefig(path, metadata={"Date": None} if str(path).endswith(".svg") else None)


def watermark(fig: Figure) -> None:
    """Marks a figure as made from simulated frames."""
    fig.text(0.992, 0.988, "simulated", ha="right", va="top", fontsize=8, style="italic", color=COLOURS[1])


def scale_bar_mm(width_mm: float) -> float:
    """A round length (1, 2 or 5 times a power of ten) of about a fifth of the width."""
    magnitude = 10.0 ** np.floor(np.log10(width_mm / 5))
    steps: NDArray[np.float64] = magnitude * np.array([1.0, 2.0, 5.0])
    return float(steps[steps <= width_mm / 5].max())
