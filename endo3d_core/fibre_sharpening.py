"""The filters that undo, on a regular grid, what a fibre bundle and its sampling blur."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import j0, ndtr

from endo3d_core.fibre import Crosstalk

SPOT_SIGMA = 0.24
"""Of a core's image behind the relay, over the cores' spacing."""
CORE_VARIANCE = 0.7**2 / 16.0
"""Of a core's own face per axis, a disc 0.7 spacings wide, in squared spacings."""
INTERPOLATION_VARIANCE = 1.0 / 8.0
"""Of linear interpolation in equilateral triangles, averaged over them: per axis, in squared spacings."""
SCENE_SPACINGS, NOISE = 10.0, 0.005
"""What the filter is best for: scenes that vary over so many cores, and noise of this variance."""
FREQUENCIES = 24
"""Per axis, at which the filter is fitted."""
REACH = 3
"""Grid points that the sharpening filter looks to each side."""
CELL, CELL_REACH = 4, 3
"""The tail is taken from cells of so many grid points, and from so many cells to each side."""
RINGS = ((6, 1.0), (6, np.sqrt(3.0)), (6, 2.0))
"""Neighbours of a hexagonal lattice: how many at which distance."""


def mixing(spacing_px: float, spot_px: int) -> float:
    """The share of a core's averaged spot that is each nearest neighbour's light.

    Averaged over directions and places of the core within its pixel.
    """
    sigma = SPOT_SIGMA * spacing_px
    angle, pixel = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False), np.arange(-40, 41)
    place = (np.arange(8) + 0.5) / 8.0

    def seen(offset: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, places) light of spots at these distances, along one axis, in the window about a core."""
        left = place[:, None] - 0.5 * (spot_px - 1)
        weight = np.clip(np.minimum(pixel + 1.0, left + spot_px) - np.maximum(pixel, left), 0.0, 1.0)
        at = pixel - place[:, None] - offset[:, None, None]
        spot = ndtr((at + 0.5) / sigma) - ndtr((at - 0.5) / sigma)
        return np.asarray((weight * spot).sum(axis=-1))

    neighbour = seen(spacing_px * np.cos(angle)).mean(axis=1) * seen(spacing_px * np.sin(angle)).mean(axis=1)
    own = seen(np.zeros(1)).mean() ** 2
    ratio = float(neighbour.mean()) / float(own)
    return ratio / (1.0 + 6.0 * ratio)


def transfer(crosstalk: Crosstalk, frequency: NDArray[np.float64], mixed: float) -> NDArray[np.float64]:
    """What the bundle's neighbours, sampling and interpolation leave of a spatial frequency, in 1/spacing."""
    k = 2.0 * np.pi * frequency
    leaked, sampled = np.ones_like(k), np.ones_like(k)
    for (count, distance), share in zip(RINGS, (crosstalk.nearest, crosstalk.second, crosstalk.second), strict=True):
        leaked += count * share * (j0(k * distance) - 1.0)
    sampled += 6.0 * mixed * (j0(k) - 1.0)
    return np.asarray(leaked * sampled * np.exp(-0.5 * (CORE_VARIANCE + INTERPOLATION_VARIANCE) * k * k))


def sharpening(crosstalk: Crosstalk, spacing: float, mixed: float) -> NDArray[np.float32]:
    """(4, 4) quadrant of a symmetric 7 x 7 filter on a grid with ``spacing`` grid steps between cores.

    The filter of that size which brings ``transfer`` nearest to 1 for scenes with the spectrum
    1 / (1 + (SCENE_SPACINGS f)^2), with NOISE of white noise; an even grey stays as it is.
    """
    f = (np.arange(FREQUENCIES) + 0.5) / (2 * FREQUENCIES)
    across, along = np.meshgrid(f, f)
    radius = np.hypot(across, along) * spacing
    passed = transfer(crosstalk, radius, mixed).ravel()
    scene = 1.0 / np.sqrt(1.0 + (SCENE_SPACINGS * radius.ravel()) ** 2)
    taps = np.arange(REACH + 1)
    cosine = np.where(taps, 2.0, 1.0) * np.cos(2.0 * np.pi * f[:, None] * taps)
    basis = np.einsum("vj,uk->vujk", cosine, cosine).reshape(f.size**2, -1)
    even = np.outer(np.where(taps, 2.0, 1.0), np.where(taps, 2.0, 1.0)).ravel()
    rows = (basis * (passed * scene)[:, None], np.sqrt(NOISE) * basis, 1e3 * f.size * even[None])
    wanted = (scene, np.zeros(f.size**2), np.array([1e3 * f.size]))
    quadrant = np.linalg.lstsq(np.concatenate(rows), np.concatenate(wanted), rcond=None)[0]
    return np.ascontiguousarray(quadrant.reshape(REACH + 1, REACH + 1), np.float32)


def tail(crosstalk: Crosstalk, spacing: float) -> NDArray[np.float32]:
    """(7, 7) share of the light of coarse cells that reaches the middle one."""
    fine = 8
    step = CELL / spacing / fine
    at = (np.arange((2 * CELL_REACH + 1) * fine) + 0.5) * step
    at -= at.mean()
    light = np.exp(-np.hypot(at[:, None], at[None, :]) / crosstalk.tail_pitches)
    cells = light.reshape(2 * CELL_REACH + 1, fine, 2 * CELL_REACH + 1, fine).sum(axis=(1, 3))
    return np.asarray(crosstalk.tail * cells / cells.sum(), np.float32)
