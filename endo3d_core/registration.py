"""Projective registration of a cloud to the visible part of the merged map (sections 3.3 and 5 of the paper).

Map points are projected into the organised grid, which replaces the closest-point search of ICP. Rows are
point-to-plane, weighted by variance, by observation count and robustly. Photometric rows compare the texture; they
are meant for directions in which the geometry is weak (``health`` decides).

The unknown is a small motion of the camera in its own axes, about the centre of the visible surface, with the
rotation scaled by the surface's radius: all six numbers are mm and comparable.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from endo3d_core import pairs, rigid
from endo3d_core.compiled import kernel
from endo3d_core.pooling import X, Y, Z

Array = NDArray[np.float64]

_SHARED = 2.0
"""Neighbouring cells share pixels of their gradients: so many points of a voxel count as one independent."""


@dataclass(frozen=True, slots=True)
class Frame6:
    """What a small motion is expressed in."""

    centre: Array
    """(3,) mm in camera axes: what rotations are about."""
    radius_mm: float
    """What turns radians into mm: the rms radius of the visible surface."""


@dataclass(frozen=True, slots=True)
class Scales:
    """What counts as near, in this iteration."""

    gate_mm: float
    """Farther points are no pairs."""
    distance_mm: float
    """Robust scale of distances."""
    texture: float
    """Robust scale of differences in texture."""
    normal_rad: float
    """1-sigma tilt of one cloud's normals, about each axis."""


@dataclass(frozen=True, slots=True)
class NormalEquations:
    """Information, gradient and what the rows were like. Matrices are (6, 6), gradients (6,)."""

    geometry: Array
    geometry_gradient: Array
    geometry_noise: Array
    """The part of ``geometry`` that noisy normals alone would make."""
    texture: Array
    """Of the photometric rows, without what grey noise alone would make."""
    texture_gradient: Array
    texture_live: Array
    """Of the cloud's own texture gradients: more than ``texture`` by one cloud's noise."""
    visible: int
    """Map points that fall onto valid cells."""
    used: int
    textured: int
    residual_mm: float
    """Robust rms of the distances."""
    tilt_rad: float
    """Typical angle about one axis between normals of map and cloud: their noise."""
    texture_residual: float
    """The same of the differences in texture, at the cloud's typical brightness."""
    texture_misfit: float
    """The plain rms of the same."""
    texture_slope: float
    """Of the cloud's texture over the map's: 1 where they match, 0 at a wrong place."""
    texture_rms: float
    """Of the map's texture: its contrast."""

    @property
    def textured_scene(self) -> bool:
        """The map's texture stands out of the differences: more than noise averaged over ``SETTLED`` points."""
        return self.texture_rms > 0.5 * self.texture_residual


def visible_surface(live: NDArray[np.float32]) -> Frame6:
    """Centre and rms radius of the points of live (PLANES, rows, columns)."""
    x, y, z, radius_mm = _middle(live, 8)
    return Frame6(np.array([x, y, z]), radius_mm)


@kernel
def _middle(live: Any, stride: int) -> Any:
    """Mean position of every ``stride``th row and column, and the rms distance to it."""
    n = 0
    x = y = z = squares = 0.0
    for r in range(0, live.shape[1], stride):
        for c in range(0, live.shape[2], stride):
            px, py, pz = float(live[X, r, c]), float(live[Y, r, c]), float(live[Z, r, c])
            if pz == pz:
                n += 1
                x, y, z, squares = x + px, y + py, z + pz, squares + px * px + py * py + pz * pz
    x, y, z = x / n, y / n, z / n
    return x, y, z, np.sqrt(squares / n - x * x - y * y - z * z)


class Points(Protocol):
    """Map points to register to: a merged map, or a part of an old one."""

    @property
    def rows(self) -> NDArray[np.float32]:
        """(n, ROW), as ``merging`` lays them out."""

    @property
    def ints(self) -> NDArray[np.int32]:
        """The same bytes."""


class Linearisation:
    """Builds normal equations at a pose; owns the rows."""

    def __init__(self) -> None:
        self._pairs = np.empty(pairs.PAIRS, np.float32)
        self._surface, self._texture = np.empty(pairs.SURFACE, np.float32), np.empty(pairs.TEXTURE, np.float32)
        self._tilts = np.empty(0, np.float32)

    def at(
        self,
        T_world_camera: Array,
        world: Points,
        chosen: NDArray[np.int32],
        live: NDArray[np.float32],
        coefficients: NDArray[np.float32],
        frame: Frame6,
        scales: Scales,
    ) -> NormalEquations:
        """Of the map's rows ``chosen`` against ``live`` (PLANES, rows, columns) with its grid's rays (2, 5)."""
        if len(self._tilts) < len(chosen):
            self._tilts = np.empty(len(chosen), np.float32)
        surface, tilted, texture = np.zeros((7, 7)), np.zeros((4, 4)), np.zeros((13, 13))
        counts, sums = pairs.linearise(
            world.rows, world.ints, chosen, live, coefficients, rigid.inverse(T_world_camera),
            frame.centre, frame.radius_mm, scales.gate_mm, scales.distance_mm, scales.texture, scales.normal_rad,
            self._pairs, self._surface, self._texture, self._tilts, surface, tilted, texture,
        )  # fmt: skip
        visible, used, textured, settled, sampled = counts
        squares, weights, texture_squares, texture_weights, of_map, of_both, inverse_counts, misfit = sums
        surface, tilted, texture = _symmetric(surface), _symmetric(tilted), _symmetric(texture)
        geometry = surface[:6, :6]
        tilt_variance = tilted[0, 0] / max(np.trace(geometry[:3, :3]), 1e-300)
        return NormalEquations(
            geometry=geometry,
            geometry_gradient=-surface[:6, 6],
            geometry_noise=_any_normal(tilted) - tilt_variance * geometry,
            texture=_signal(texture, textured / max(_SHARED * inverse_counts, 1e-30)),
            texture_gradient=-texture[:6, 12],
            texture_live=texture[6:12, 6:12],
            visible=visible,
            used=used,
            textured=textured,
            residual_mm=math.sqrt(squares / max(weights, 1e-30)),
            tilt_rad=math.sqrt(np.median(self._tilts[:sampled]) / math.log(2.0)) if sampled else 0.0,
            texture_residual=math.sqrt(texture_squares / max(texture_weights, 1e-30)),
            texture_misfit=math.sqrt(misfit / max(textured, 1)),
            texture_slope=of_both / max(of_map, 1e-30),
            texture_rms=math.sqrt(of_map / max(settled, 1)),
        )


def _symmetric(lower: Array) -> Array:
    """From its lower triangle."""
    full: Array = lower + np.tril(lower, -1).T
    return full


def _signal(texture: Array, count: float) -> Array:
    """(6, 6) information of the texture's true gradients, from the Gram matrix (13, 13) of the photometric rows.

    Cloud and map have the same signal S; one has the noise N, the other, averaged over ``count`` points, N / count.
    Solved for S this holds at a wrong pose too. A map of one cloud tells nothing about N: then it is what the
    gradients of both, with their independent noise, have in common.
    """
    of_map, of_live, common = texture[:6, :6], texture[6:12, 6:12], texture[:6, 6:12]
    if count < 2.0:
        both: Array = 0.5 * (common + common.T)
        return both
    signal: Array = (of_map - of_live / count) / (1.0 - 1.0 / count)
    return signal


def _any_normal(tilted: Array) -> Array:
    """(6, 6) information of normals that point anywhere, from the sums (4, 4) of w (1, s)(1, s)^T."""
    S = tilted[1:, 1:]
    M = np.zeros((6, 6))
    M[:3, :3] = tilted[0, 0] * np.eye(3)
    M[3:, :3] = rigid.skew(tilted[0, 1:])
    M[:3, 3:] = M[3:, :3].T
    M[3:, 3:] = np.trace(S) * np.eye(3) - S
    return M
