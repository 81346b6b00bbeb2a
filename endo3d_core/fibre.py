"""Imaging fibres: find the cores, and see the scene instead of them.

A bundle of 50 000 to 100 000 cores shows the scene through a honeycomb: every core averages its spot, has a gain
of its own, and leaks light into its neighbours. One sparse operator, made once from a flat image, turns camera
pixels into a regular grid at the fibre's resolution:

    grid = interpolate . (deconvolve crosstalk) . (divide by flat) . (average a core's pixels) . pixels

The crosstalk is the first-order inverse of a leak into the nearest cores (Drangmeister et al. compensate the same
way): (1 + k A)^-1 ~ 1 - k A + k^2 A^2, which keeps the operator sparse.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.spatial import Delaunay, cKDTree

from endo3d_core.compiled import kernel

NEIGHBOURS = 6
"""Of a core in a hexagonal bundle."""
SPOT_SHARE = 0.35
"""Radius of the averaged spot over the core spacing: a core's bright middle."""
LIT_SHARE = 0.15
"""A core belongs to the bundle if the flat is this bright there, of its 99th percentile."""


def core_spacing(flat: NDArray[np.generic]) -> float:
    """Distance of neighbouring cores in px, from the honeycomb's ring in the spectrum of a flat image.

    Raises ``ValueError`` when there is no honeycomb.
    """
    side = min(1024, *flat.shape)
    top, left = ((n - side) // 2 for n in flat.shape)
    middle = flat[top : top + side, left : left + side].astype(np.float64)
    window = np.hanning(side)
    spectrum = np.abs(np.fft.fftshift(np.fft.fft2((middle - middle.mean()) * np.outer(window, window)))) ** 2
    v, u = np.indices(spectrum.shape) - side // 2
    radius = np.hypot(u, v).astype(int)
    ring = np.bincount(radius.ravel(), spectrum.ravel())[: side // 2] / np.bincount(radius.ravel())[: side // 2]
    # Cores are 2.2 px apart or more and fewer than 20: the ring lies in between; weighted to undo the fall of 1/f.
    low, high = side // 20, int(side / 2.2)
    weighted = ring[low:high] * np.arange(low, high) ** 2
    peak = int(np.argmax(weighted))
    if weighted[peak] <= 3.0 * np.median(weighted):
        raise ValueError("no honeycomb of fibre cores in this image; take a flat, well focused one")
    # The first ring of a hexagonal lattice of spacing d is at 2 / (sqrt(3) d).
    return float(side / (low + peak) * 2.0 / np.sqrt(3.0))


def find_cores(flat: NDArray[np.generic], spacing_px: float | None = None) -> NDArray[np.float64]:
    """(n, 2) core centres (x, y) in px, to a fraction of a pixel, from a flat image (height, width)."""
    spacing = spacing_px or core_spacing(flat)
    smooth = ndimage.gaussian_filter(flat.astype(np.float64), 0.18 * spacing)
    size = max(3, int(np.floor(0.8 * spacing)) | 1)
    peak = (smooth == ndimage.maximum_filter(smooth, size)) & (smooth > LIT_SHARE * np.percentile(smooth, 99))
    peak[[0, -1]] = peak[:, [0, -1]] = False
    y, x = np.nonzero(peak)
    # The vertex of the parabola through three samples, per axis.
    offsets = []
    for before, after in ((smooth[y, x - 1], smooth[y, x + 1]), (smooth[y - 1, x], smooth[y + 1, x])):
        bend = before - 2.0 * smooth[y, x] + after
        offsets.append(np.clip(np.where(bend < 0, 0.5 * (before - after) / np.minimum(bend, -1e-9), 0.0), -0.5, 0.5))
    return np.stack((x + offsets[0], y + offsets[1]), axis=-1)


def _averaging(cores: NDArray[np.float64], shape: tuple[int, int], radius_px: float) -> sparse.csr_matrix:
    """(cores, pixels): the mean over the pixels within a radius of each core."""
    reach = int(np.ceil(radius_px))
    dv, du = (d.ravel() for d in np.mgrid[-reach : reach + 1, -reach : reach + 1])
    centre = np.rint(cores).astype(int)
    u, v = centre[:, :1] + du, centre[:, 1:] + dv
    near = np.hypot(u - cores[:, :1], v - cores[:, 1:]) <= max(radius_px, 0.75)
    near &= (u >= 0) & (v >= 0) & (u < shape[1]) & (v < shape[0])
    core = np.nonzero(near)[0]
    weight = 1.0 / near.sum(axis=1)[core]
    return sparse.csr_matrix((weight, (core, (v * shape[1] + u)[near])), (len(cores), shape[0] * shape[1]))


def _leak(cores: NDArray[np.float64], spacing_px: float, share: float) -> sparse.csr_matrix:
    """(cores, cores): what each core gets from its nearest neighbours, ``share`` from each."""
    distance, index = (np.asarray(found) for found in cKDTree(cores).query(cores, NEIGHBOURS + 1))
    near = distance[:, 1:] < 1.5 * spacing_px
    rows = np.nonzero(near)[0]
    columns = index[:, 1:][near]
    return sparse.csr_matrix((np.full(rows.size, share), (rows, columns)), (len(cores), len(cores)))


def _interpolation(
    cores: NDArray[np.float64], grid: NDArray[np.float64]
) -> tuple[sparse.csr_matrix, NDArray[np.bool_]]:
    """(grid points, cores) barycentric weights in the cores' Delaunay triangles, and which points lie inside."""
    mesh = Delaunay(cores)
    simplex = mesh.find_simplex(grid)
    inside = simplex >= 0
    transform = mesh.transform[simplex[inside]]
    two = np.einsum("nij,nj->ni", transform[:, :2], grid[inside] - transform[:, 2])
    weights = np.concatenate((two, 1.0 - two.sum(axis=1, keepdims=True)), axis=1)
    rows = np.repeat(np.nonzero(inside)[0], 3)
    columns = mesh.simplices[simplex[inside]].ravel()
    return sparse.csr_matrix((weights.ravel(), (rows, columns)), (len(grid), len(cores))), inside


@dataclass(frozen=True, eq=False)
class FibreOperator:
    """Pixels -> grid, in two sparse steps: pixels to corrected cores, cores to the grid. Made by ``build``."""

    cores: NDArray[np.float64]
    """(n, 2) px."""
    spacing_px: float
    gain: NDArray[np.float64]
    """(n,) of each core over the smooth course of the flat."""
    grid_shape: tuple[int, int]
    to_cores: sparse.csr_matrix
    to_grid: sparse.csr_matrix
    inside: NDArray[np.bool_]
    """(height, width) of the grid: within the bundle."""

    def __call__(self, image: NDArray[np.uint8], out: NDArray[np.float32], scratch: NDArray[np.float32]) -> None:
        """(height, width) image -> out (grid_shape), 0 outside the bundle. ``scratch`` is (cores,)."""
        _apply_bytes(self.to_cores.indptr, self.to_cores.indices, self.to_cores.data, image.reshape(-1), scratch)
        _apply(self.to_grid.indptr, self.to_grid.indices, self.to_grid.data, scratch, out.reshape(-1))


def build(
    flat: NDArray[np.generic], grid_px: float, *, leak_share: float = 0.0, spacing_px: float | None = None
) -> FibreOperator:
    """The operator for a camera that sees a bundle, from its flat image; ``grid_px`` camera pixels per grid step.

    ``leak_share`` is the light that a core gives to each of its six neighbours (0.04 for the design's bundles).
    """
    spacing = spacing_px or core_spacing(flat)
    cores = find_cores(flat, spacing)
    if len(cores) < 100:
        raise ValueError(f"only {len(cores)} fibre cores found; the flat image must show a lit bundle")
    shape = (flat.shape[0], flat.shape[1])
    average = _averaging(cores, shape, SPOT_SHARE * spacing)
    raw = average @ flat.reshape(-1).astype(np.float64)
    leak = _leak(cores, spacing, leak_share)
    sharpen = sparse.identity(len(cores), format="csr") - leak + leak @ leak
    lit = sharpen @ raw
    level = float(np.median(lit))
    # Cores nearly dark would amplify noise only: the gain's correction is limited.
    correct = sparse.diags(level / np.maximum(lit, 0.2 * level))
    height, width = (int(n / grid_px) for n in shape)
    v, u = np.mgrid[0:height, 0:width]
    grid = (np.stack((u, v), axis=-1).reshape(-1, 2) + 0.5) * grid_px - 0.5
    interpolate, inside = _interpolation(cores, grid)
    nearest = cKDTree(cores).query(cores, NEIGHBOURS + 1)[1]
    return FibreOperator(
        cores=cores,
        spacing_px=spacing,
        gain=lit / np.median(lit[nearest], axis=1),
        grid_shape=(height, width),
        to_cores=_single(average),
        to_grid=_single(interpolate @ correct @ sharpen),
        inside=inside.reshape(height, width),
    )


def _single(matrix: sparse.csr_matrix) -> sparse.csr_matrix:
    tidy = sparse.csr_matrix(matrix, dtype=np.float32)
    tidy.sum_duplicates()
    return tidy


@kernel
def _apply(
    starts: NDArray[np.int32],
    columns: NDArray[np.int32],
    weights: NDArray[np.float32],
    values: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    for i in range(out.size):
        total = np.float32(0.0)
        for k in range(starts[i], starts[i + 1]):
            total += weights[k] * values[columns[k]]
        out[i] = total


@kernel
def _apply_bytes(
    starts: NDArray[np.int32],
    columns: NDArray[np.int32],
    weights: NDArray[np.float32],
    values: NDArray[np.uint8],
    out: NDArray[np.float32],
) -> None:
    for i in range(out.size):
        total = np.float32(0.0)
        for k in range(starts[i], starts[i + 1]):
            total += weights[k] * np.float32(values[columns[k]])
        out[i] = total
