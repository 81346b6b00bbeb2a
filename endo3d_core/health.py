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
"""Geometry with a larger 1-sigma than this, in point sigmas, asks the texture for help."""
HELD = 1.0
"""A direction that is known no better than a single point, 1-sigma in point sigmas, is not moved at all."""
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
    weak: bool
    """Some direction asked the texture for help."""
    sigma_weak_mm: float
    weak_direction: Array
    """(6,) unit vector, scaled coordinates."""
    photometric_share: float
    """Share of the information along the weak directions that is the texture's."""


def solve(n: NormalEquations, sigma_mm: float) -> Solution:
    """Gauss-Newton step in the observable directions; ``sigma_mm`` is the points' noise."""
    geometry = n.geometry - n.geometry_noise
    values, vectors = np.linalg.eigh(geometry)
    weak = vectors[:, values < 1.0 / (WEAK * sigma_mm) ** 2]
    textured = _textured_directions(n, weak)
    P = textured @ textured.T
    texture = P @ n.texture @ P
    # More spread than the points' sigma says (model errors) makes every estimate that much less certain.
    excess = max(1.0, n.residual_mm / sigma_mm) ** 2
    information = (geometry + texture) / excess
    values, vectors = np.linalg.eigh(information)
    free = vectors[:, values >= 1.0 / (HELD * sigma_mm) ** 2]
    held = vectors[:, values < 1.0 / (HELD * sigma_mm) ** 2]
    gradient = n.geometry_gradient + P @ n.texture_gradient
    step = free @ np.linalg.solve(free.T @ (geometry + texture) @ free, free.T @ gradient)
    in_weak = float(np.trace(textured.T @ geometry @ textured)) if textured.size else 0.0
    from_texture = float(np.trace(texture))
    return Solution(
        step=step,
        information=information,
        held=held,
        weak=weak.size > 0,
        sigma_weak_mm=float(1.0 / np.sqrt(max(values[0], 1e-12))),
        weak_direction=vectors[:, 0],
        photometric_share=from_texture / (from_texture + max(in_weak, 0.0)) if from_texture > 0 else 0.0,
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
