"""One pose of the board or of the flat reference: its images become samples, its samples a sighting."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from endo3d_core.calibrating.boards import Board
from endo3d_core.calibrating.correspondence import ProjectorMap, projector_map, sample
from endo3d_core.calibrating.refining import refine
from endo3d_core.calibrating.retina import Retina
from endo3d_core.calibrating.sighting import Sighting
from endo3d_core.patterns import Pattern

EDGE_PX = 0.6
"""Sigma of a printed edge's blur in an image that is in focus."""
FEATURES_LEAST = 8
NEAR = 0.45
"""Of the distance between features: within it the projector's coordinate is fitted."""
SATURATED = 0.98
LIT = 0.05
"""Of the brightest samples: what is darker sees no surface."""

Window = tuple[int, int]
"""(width, height) of the projector, px."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A pose as the retina's n samples."""

    name: str
    map_x: ProjectorMap
    map_y: ProjectorMap
    fringes: NDArray[np.float32]
    """(patterns, n) of the columns' sequence: for the response."""
    patterns: tuple[Pattern, ...]
    """Those."""
    picture: NDArray[np.uint8]
    """(height, width) without fringes and honeycomb."""

    @property
    def white(self) -> NDArray[np.float64]:
        """(n,) the surface in even light, grey values."""
        return np.asarray((self.map_x.white + self.map_y.white) / 2)

    @property
    def lit(self) -> NDArray[np.bool_]:
        """(n,) bright enough to be the surface."""
        return np.asarray(self.white > LIT * np.percentile(self.white, 99))


def view(
    name: str,
    retina: Retina,
    columns: tuple[Iterable[NDArray[Any]], tuple[Pattern, ...]],
    rows: tuple[Iterable[NDArray[Any]], tuple[Pattern, ...]],
    window: Window,
) -> View:
    """Images in the order of their patterns, per axis -> what they show. Raises ``ValueError``."""
    maps, means, seen = [], [], []
    for (images, patterns), length_px in zip((columns, rows), window, strict=True):
        full, total, samples = 255.0, None, []
        for image in images:
            full = float(np.iinfo(image.dtype).max)
            samples.append(retina.sample(image))
            total = image.astype(np.float32) if total is None else total + image
        if len(samples) != len(patterns) or total is None:
            raise ValueError(f"{len(samples)} images for {len(patterns)} patterns")
        stack = np.stack(samples)
        maps.append(projector_map(stack, patterns, length_px, saturation=SATURATED * full))
        means.append(total / len(samples))
        seen.append(stack)
    return View(name, maps[0], maps[1], seen[0], columns[1], retina.picture((means[0] + means[1]) / 2))


def sight(seen: View, board: Board, retina: Retina) -> Sighting:
    """The board's features in both images. Raises ``ValueError`` with the reason for the one who holds the board."""
    share = float(np.mean(np.isfinite(seen.map_x.coordinate_px[seen.lit])))
    found = board.find(seen.picture)
    if found is None:
        whole = "at least six corners of it" if board.kind == "charuco" else "the whole of it"
        raise ValueError(f"no {board.text} found; show {whole}, in focus and evenly lit")
    board_mm, pixels = found
    samples = retina.even(np.asarray(seen.white, np.float32))
    pixels = refine(board, board_mm, pixels, retina, samples, EDGE_PX)
    between = np.asarray(cKDTree(found[1]).query(found[1], 2)[0])
    spacing_px = float(np.median(between[:, 1]))
    projector_px = sample(retina.points, retina.tree, seen.map_x, seen.map_y, pixels, NEAR * spacing_px)
    known = np.all(np.isfinite(np.hstack((pixels, projector_px))), axis=1)
    if known.sum() < FEATURES_LEAST:
        raise ValueError(
            f"only {known.sum()} of {len(known)} features are lit by readable fringes ({share:.0%} of the view is); "
            "more light, or less: nothing may be saturated"
        )
    return Sighting(seen.name, board_mm[known], pixels[known], projector_px[known])


def covered(sightings: list[Sighting], inside: NDArray[np.float64]) -> NDArray[np.int64]:
    """(CELLS, CELLS) features per cell of the field that ``inside`` (n, 2) px spans; -1 outside of it."""
    edges = [np.linspace(inside[:, k].min(), inside[:, k].max() + 1e-6, CELLS + 1) for k in (0, 1)]
    lit = np.histogram2d(inside[:, 1], inside[:, 0], bins=edges[::-1])[0]
    pixels = np.concatenate([s.camera_px for s in sightings]) if sightings else np.zeros((0, 2))
    count = np.histogram2d(pixels[:, 1], pixels[:, 0], bins=edges[::-1])[0]
    return np.where(lit > 0.5 * np.percentile(lit, 90), count, -1).astype(np.int64)


CELLS = 10


def share_covered(cells: NDArray[np.int64]) -> float:
    """Of the field's cells, those with a feature."""
    return float(np.mean(cells[cells >= 0] > 0))


def drawn(cells: NDArray[np.int64]) -> str:
    """The cells as lines of text: how many features each holds."""
    marks = {-1: "  ", 0: " ."}
    return "\n".join("".join(marks.get(int(n), f"{min(int(n), 99):2d}") for n in row) for row in cells)
