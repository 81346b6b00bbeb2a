"""Which projector coordinate lights a camera pixel: absolute phase without any knowledge of the rig.

For calibration only, where accuracy counts and speed does not: plain numpy, every pattern used at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from endo3d_core.demodulation import demodulation, unwrapping_chain
from endo3d_core.patterns import Pattern

TWO_PI = 2.0 * math.pi


@dataclass(frozen=True, slots=True, eq=False)
class ProjectorMap:
    """One axis of the projector as the camera sees it; arrays have the frames' shape, float64."""

    coordinate_px: NDArray[np.float64]
    """Projector pixel along the axis; NaN where the phase is not to be trusted."""
    contrast: NDArray[np.float64]
    """Fringe modulation over background, b / a."""
    modulation: NDArray[np.float64]
    """Fringe modulation b in grey values: the phase's weight is its square."""
    white: NDArray[np.float64]
    """Background a: the scene without fringes, grey values."""


def projector_map(
    frames: NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float32],
    patterns: tuple[Pattern, ...],
    length_px: int,
    *,
    contrast_min: float = 0.1,
    saturation: float = math.inf,
) -> ProjectorMap:
    """frames (patterns, ...) -> map, by least squares per pixel and heterodyne unwrapping.

    ``length_px`` is the projector's size along the patterns' axis. Pixels that saturate in any frame, and
    those whose beats disagree by more than a third of a period, are NaN. Raises ``ValueError`` when the
    frequencies are not unique over the projector.
    """
    frequencies = tuple(dict.fromkeys(pattern.frequency for pattern in patterns))
    chain = unwrapping_chain(frequencies)
    widest = abs(chain[0][1]) if chain else frequencies[0]
    if widest > 1.0 + 1e-9:
        raise ValueError(
            f"these patterns repeat {widest:g} times over the projector; "
            "calibration needs two frequencies that differ by one period"
        )
    components = np.tensordot(demodulation(patterns, frequencies), frames.astype(np.float64), axes=1)
    white, cosine, sine = components[0], components[1::2], components[2::2]
    wrapped = np.arctan2(sine, cosine)
    modulation = np.hypot(sine[0], cosine[0])

    # Widest beat first: each known absolute phase fixes the fringe order of the next, finer one.
    phase, known, worst = np.zeros_like(white), 0.0, np.zeros_like(white)
    for index, rung in [*chain, (-1, frequencies[0])]:
        value = wrapped[0] - (wrapped[index] if index >= 0 else 0.0)
        value = np.mod(value if rung > 0 else -value, TWO_PI)
        rung = abs(rung)
        if known:
            order = (phase * rung / known - value) / TWO_PI
            worst = np.maximum(worst, np.abs(order - np.rint(order)))
            value = value + TWO_PI * np.rint(order)
        phase, known = value, rung

    coordinate = phase / TWO_PI * length_px / frequencies[0]
    contrast = modulation / np.maximum(white, 1e-9)
    trusted = (contrast > contrast_min) & (worst < 1 / 3) & (frames.max(axis=0) < saturation)
    return ProjectorMap(np.where(trusted, coordinate, np.nan), contrast, modulation, white)


def sample(
    points: NDArray[np.float64],
    tree: cKDTree,
    map_x: ProjectorMap,
    map_y: ProjectorMap,
    pixels: NDArray[np.float64],
    radius_px: float,
) -> NDArray[np.float64]:
    """(n, 2) camera pixels -> (n, 2) projector pixels, NaN where too little around is valid.

    ``points`` (m, 2) are where the maps' m values were seen, ``tree`` is of them. Around each pixel both
    coordinates are fitted by a second-order surface, weighted with the modulation squared (the inverse variance of
    a phase), and outliers are dropped once: a feature lies on an edge of the print, where the pixel itself is the
    worst witness.
    """
    out = np.full(pixels.shape, np.nan)
    columns = [(m.coordinate_px.ravel(), m.modulation.ravel()) for m in (map_x, map_y)]
    for i, pixel in enumerate(pixels):
        if not np.all(np.isfinite(pixel)):
            continue
        near = np.asarray(tree.query_ball_point(pixel, radius_px), np.int64)
        if near.size:
            x, y = ((points[near] - pixel) / radius_px).T
            terms = np.stack((np.ones_like(x), x, y, x * x, x * y, y * y), axis=-1)
            out[i] = [_centre_of_fit(terms, values[near], weight[near]) for values, weight in columns]
    return out


def _centre_of_fit(
    terms: NDArray[np.float64], values: NDArray[np.float64], weight: NDArray[np.float64]
) -> float:
    """The fitted surface's value where all but the constant term vanish."""
    use = np.isfinite(values)
    for _ in range(2):
        if use.sum() < 2 * terms.shape[-1] or use.sum() < len(values) / 3:
            return math.nan
        A, b, w = terms[use], values[use], weight[use]
        solution = np.linalg.lstsq(A * w[:, None], b * w, rcond=None)[0]
        residual = np.abs(values - terms @ solution)
        use &= residual < 4 * 1.4826 * np.median(residual[use]) + 1e-9
    return float(solution[0])
