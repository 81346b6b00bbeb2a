"""What a registration knows: which directions are weak, which must be held, and the solution in the others.

All in the scaled coordinates of ``registration``: six lengths in mm. Thresholds are multiples of the cloud's own
point noise, so they hold for every head.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from endo3d_core import rigid
from endo3d_core.registration import Frame6, NormalEquations

Array = NDArray[np.float64]

WEAK = 0.1
"""Geometry with a larger 1-sigma than this, in units of the points' spread, asks the texture for help."""
HELD = 1.0
"""A direction that is known worse than the spread of single points is not moved at all."""
SIGNAL = 1.0 - 1.0 / 1.4
"""Least share of signal in the cloud's texture gradients along a direction: their energy is then 1.4 times that of
their noise. Less is mostly shading, which moves with the camera."""


@dataclass(frozen=True, slots=True)
class Solution:
    """A step and its quality."""

    step: Array
    """(6,) mm, scaled coordinates; zero along held directions."""
    information: Array
    """(6, 6) 1/mm^2, scaled coordinates, without what noise alone would make."""
    held: Array
    """(6, k) orthonormal directions that are held."""
    sigma_weak_mm: float
    weak_direction: Array
    """(6,) unit vector, scaled coordinates."""
    photometric_share: float
    """Share of the information along the weak directions that is the texture's."""


def solve(n: NormalEquations, sigma_mm: float) -> Solution:
    """Gauss-Newton step in the observable directions; ``sigma_mm`` is what the cloud says of its points' noise."""
    # More spread than that (errors that are no noise) makes the geometry that much less certain; the photometric
    # rows are weighted by their own spread.
    spread_mm = max(sigma_mm, n.residual_mm)
    shrink = (sigma_mm / spread_mm) ** 2
    geometry = shrink * (n.geometry - n.geometry_noise)
    values, vectors = np.linalg.eigh(geometry)
    textured = _textured_directions(n, vectors[:, values < 1.0 / (WEAK * spread_mm) ** 2])
    P = textured @ textured.T
    texture = P @ n.texture @ P
    information = geometry + texture
    gradient = shrink * n.geometry_gradient + P @ n.texture_gradient
    values, vectors = np.linalg.eigh(information)
    known = values >= 1.0 / (HELD * spread_mm) ** 2
    free = vectors[:, known]
    from_geometry = max(float(np.trace(textured.T @ geometry @ textured)), 0.0)
    from_texture = float(np.trace(texture))
    return Solution(
        step=free @ (free.T @ gradient / values[known]),
        information=information,
        held=vectors[:, ~known],
        sigma_weak_mm=float(1.0 / np.sqrt(max(values[0], 1e-12))),
        weak_direction=vectors[:, 0],
        photometric_share=from_texture / (from_texture + from_geometry) if textured.size else 0.0,
    )


def _textured_directions(n: NormalEquations, weak: Array) -> Array:
    """(6, k) orthonormal directions among ``weak`` along which there is texture to follow."""
    if weak.size == 0 or n.textured == 0:
        return np.zeros((6, 0))
    _, mixed = np.linalg.eigh(weak.T @ n.texture @ weak)
    directions = weak @ mixed
    signal = np.einsum("ik,ij,jk->k", directions, n.texture, directions)
    of_live = np.einsum("ik,ij,jk->k", directions, n.texture_live, directions)
    chosen: Array = directions[:, signal > SIGNAL * of_live]
    return chosen


def motion(step: Array, frame: Frame6) -> Array:
    """The step (6,) as the camera's motion T_before_after (4, 4)."""
    twist = np.concatenate([step[:3], step[3:] / frame.radius_mm])
    return rigid.translation(frame.centre) @ rigid.exp(twist) @ rigid.translation(-frame.centre)


def scaled_twist(T: Array, frame: Frame6) -> Array:
    """The inverse of ``motion``."""
    twist = rigid.log(rigid.translation(-frame.centre) @ T @ rigid.translation(frame.centre))
    return np.concatenate([twist[:3], frame.radius_mm * twist[3:]])


def at_camera(information: Array, frame: Frame6) -> Array:
    """(6, 6) information of (translation mm, rotation rad) of the camera's own origin."""
    scale = np.diag([1.0, 1.0, 1.0, frame.radius_mm, frame.radius_mm, frame.radius_mm])
    A = scale @ rigid.adjoint(rigid.translation(-frame.centre))
    out: Array = A.T @ information @ A
    return out
