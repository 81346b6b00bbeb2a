"""The correction that makes a flat reference flat: ``Bow``, fitted to planes of unknown pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from endo3d_core.bow import POWERS, Bow, terms
from endo3d_core.calibration import Rig
from endo3d_core.triangulation import exact_depth

CELLS = 32
"""Per side of the field: the correction is smooth, single samples are noisy."""
SAMPLES_LEAST = 12
"""Of a cell that counts."""
DEPTHS_DIFFER = 0.03
"""Relative difference of the planes' depths from which on the correction may vary with depth."""
ROUNDS = 6
KEPT = 5.0
"""Standard deviations from a smooth surface within which a cell belongs to it."""
RIDGE = 1e-6
"""Of the largest normal equation's diagonal: what the planes don't show stays zero."""


@dataclass(frozen=True, slots=True, eq=False)
class Flat:
    """A plane as measured: means over cells, all (n,)."""

    name: str
    x: NDArray[np.float64]
    """Slopes of the rays."""
    y: NDArray[np.float64]
    q: NDArray[np.float64]
    """1/z, 1/mm."""


def measured(name: str, rig: Rig, pixels: NDArray[np.float64], coordinate_px: NDArray[np.float64]) -> Flat:
    """From camera pixels (n, 2) and the columns' projector coordinate (n,), NaN where there is none."""
    use = np.isfinite(coordinate_px)
    rays = rig.camera.ray(pixels[use])
    z = exact_depth(rig, pixels[use], coordinate_px[use], _depth(rig))
    good = np.isfinite(z) & (z > 0)
    rays, q = rays[good], 1.0 / z[good]
    edges = [np.linspace(rays[:, k].min(), rays[:, k].max() + 1e-9, CELLS + 1) for k in (0, 1)]
    cell = (np.digitize(rays[:, 1], edges[1]) - 1) * CELLS + np.digitize(rays[:, 0], edges[0]) - 1
    order = np.argsort(cell, kind="stable")
    starts = np.flatnonzero(np.diff(cell[order], prepend=-1))
    means = []
    for members in np.split(order, starts[1:]):
        if len(members) >= SAMPLES_LEAST:
            # Wrong fringe orders lie far away: the mean of the middle half.
            middle = members[np.argsort(q[members])[len(members) // 4 : -(len(members) // 4)]]
            means.append((*rays[middle, :2].mean(axis=0), q[middle].mean()))
    if len(means) < 4 * len(POWERS):
        raise ValueError(f"{name}: too little of the flat reference is measured; fill the field with it")
    x, y, q = np.array(means).T
    # The rim, where fringes are read wrongly here and there, is no part of the reference.
    A = np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=-1)
    kept = np.ones(len(q), np.bool_)
    for _ in range(ROUNDS):
        off = np.abs(q - A @ np.linalg.lstsq(A[kept], q[kept], rcond=None)[0])
        kept = off < KEPT * 1.4826 * np.median(off[kept])
    return Flat(name, x[kept], y[kept], q[kept])


def fit(flats: list[Flat]) -> Bow:
    """Least squares over all planes at once, in mm of depth. Without planes there is no correction."""
    if not flats:
        return Bow()
    middle = float(np.mean([flat.q.mean() for flat in flats]))
    depths = np.array([1.0 / flat.q.mean() for flat in flats])
    varies = np.ptp(depths) > DEPTHS_DIFFER * depths.mean()
    rows, values = [], []
    for index, flat in enumerate(flats):
        weight = 1.0 / flat.q**2  # dz = z^2 dq
        bend = terms(flat.x, flat.y, flat.q, middle)
        if not varies:
            bend = np.where([k == 0 for _, _, k in POWERS], bend, 0.0)
        planes = np.zeros((len(flat.q), 3 * len(flats)))
        planes[:, 3 * index : 3 * index + 3] = np.stack((np.ones_like(flat.x), flat.x, flat.y), axis=-1)
        rows.append(np.hstack((bend, -planes)) * weight[:, None])
        values.append(-flat.q * weight)
    A, b = np.vstack(rows), np.concatenate(values)
    scale = np.maximum(np.linalg.norm(A, axis=0), 1e-30)
    A = A / scale
    normal = A.T @ A
    normal[np.diag_indices(len(POWERS))] += RIDGE
    solution = np.linalg.solve(normal + 1e-15 * np.eye(len(normal)), A.T @ b) / scale
    return Bow(middle, tuple(float(c) for c in solution[: len(POWERS)]))


def flatness_um(flat: Flat, bow: Bow) -> NDArray[np.float64]:
    """(n,) distances of the corrected cells from their plane, along the axis."""
    q = flat.q + bow(flat.x, flat.y, flat.q)
    A = np.stack((np.ones_like(q), flat.x, flat.y), axis=-1)
    weight = 1.0 / q**2
    plane = A @ np.linalg.lstsq(A * weight[:, None], q * weight, rcond=None)[0]
    return np.asarray(1e3 * (1.0 / q - 1.0 / plane))


def _depth(rig: Rig) -> float:
    """About where the optical axes come nearest to each other."""
    centre, axis = rig.projector_centre_mm, rig.R[2]
    cosine = float(axis[2])
    along = float(centre[2] - cosine * (centre @ axis)) / max(1.0 - cosine**2, 1e-9)
    return max(along, 1.0)
