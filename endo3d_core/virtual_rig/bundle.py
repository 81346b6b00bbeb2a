"""An imaging fibre bundle: jittered hexagonal cores that average, leak, differ, and are imaged as discs.

Figures for Fujikura bundles from the literature: pitch 4 um, jitter 5..10 %, crosstalk of 4 % to each of
the six nearest neighbours, 0.4 % to the next twelve, and an exponential tail of 3 %.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len
from scipy.spatial import cKDTree
from scipy.special import ndtr

from endo3d_core.compiled import kernel

JITTER = 0.05
"""Standard deviation of a core's position in the lattice, of the pitch, per axis."""
STRAIN, STRAIN_PITCHES, STRAIN_WAVES = 0.025, 25.0, 24
"""The lattice is drawn, not grown: its pitch varies slowly, by so much (rms), with that wavelength."""
CORE_WIDTH = 0.7
"""Diameter of a core, of the pitch."""
GAIN_SIGMA = 0.12
"""Of the cores' log-normal transmission."""
NEAREST, NEXT = (6, 0.04), (12, 0.004)
"""Neighbours and the share of its light that a core loses to each of them."""
TAIL_SHARE, TAIL_PITCHES = 0.03, 4.0
"""Of the exponential tail: its share and its length."""


@dataclass(frozen=True, eq=False)
class Sparse:
    """Weighted sums: out[i] = sum of weights[k] * values[columns[k]], k in starts[i]..starts[i+1]."""

    starts: NDArray[np.uint32]
    columns: NDArray[np.uint32]
    weights: NDArray[np.float32]

    def __call__(self, values: NDArray[np.float32], out: NDArray[np.float32]) -> NDArray[np.float32]:
        _sums(self.starts, self.columns, self.weights, values, out)
        return out


@kernel
def _sums(
    starts: NDArray[np.uint32],
    columns: NDArray[np.uint32],
    weights: NDArray[np.float32],
    values: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    for i in range(starts.size - 1):
        total = np.float32(0.0)
        for k in range(starts[i], starts[i + 1]):
            total += weights[k] * values[columns[k]]
        out[i] = total


class Bundle:
    """A bundle whose input and output faces both lie on a pixel grid."""

    def __init__(self, width: int, height: int, circle_px: float, pitch_px: float, spot_px: float, seed: int) -> None:
        """``spot_px``: sigma of a core's image on the output grid."""
        rng = np.random.default_rng(seed)
        self.width, self.height, self.pitch_px = width, height, pitch_px
        self.cores = _lattice(width, height, circle_px, pitch_px, rng)
        """(n, 2) u, v."""
        gain = rng.lognormal(-(GAIN_SIGMA**2) / 2, GAIN_SIGMA, len(self.cores))
        self.gain = gain.astype(np.float32)
        self._face = _face(self.cores, width, height, CORE_WIDTH / 2 * pitch_px)
        self._leak = _leak(self.cores)
        self._tail = _Tail(self.cores, pitch_px)
        self._image = _image(self.cores, width, height, spot_px, pitch_px)

    def transmit(self, light: NDArray[np.float32], crosstalk: bool = True) -> NDArray[np.float32]:
        """(n,) what leaves each core, of the (height, width) light on the input face."""
        cores = self._face(light.reshape(-1), np.empty(len(self.cores), np.float32))
        if crosstalk:
            near = self._leak(cores, np.empty_like(cores))
            near += self._tail(cores)
            cores = near
        return np.asarray(cores * self.gain)

    def image(self, cores: NDArray[np.float32]) -> NDArray[np.float32]:
        """(height, width) the output face; an even field keeps its mean."""
        out = np.empty(self.width * self.height, np.float32)
        return self._image(cores, out).reshape(self.height, self.width)


@lru_cache(maxsize=4)
def bundle(width: int, height: int, circle_px: float, pitch_px: float, spot_px: float, seed: int) -> Bundle:
    """A bundle of that make; building one takes seconds."""
    return Bundle(width, height, circle_px, pitch_px, spot_px, seed)


def _lattice(
    width: int, height: int, circle_px: float, pitch_px: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    n = math.ceil(circle_px / pitch_px) + 2
    i, j = np.meshgrid(np.arange(-n, n + 1), np.arange(-n, n + 1))
    u = pitch_px * (i + 0.5 * (j % 2))
    v = pitch_px * math.sqrt(0.75) * j
    # A bundle is never mounted square to the camera's rows.
    c, s = math.cos(0.21), math.sin(0.21)
    cores = np.stack((c * u - s * v, s * u + c * v), axis=-1).reshape(-1, 2)
    cores = cores[np.hypot(*cores.T) <= circle_px / 2]
    cores += _drawn(cores / pitch_px, rng) * pitch_px
    cores += rng.normal(0.0, JITTER * pitch_px, cores.shape)
    cores = cores[np.lexsort((cores[:, 0], np.floor(cores[:, 1] / (8 * pitch_px))))]
    return np.asarray(cores + np.array(((width - 1) / 2, (height - 1) / 2)))


def _drawn(at: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """(n, 2) displacement of lattice points, all in pitches: random waves of the given rms strain."""
    direction = rng.uniform(0.0, 2 * math.pi, STRAIN_WAVES)
    k = 2 * math.pi / STRAIN_PITCHES * rng.uniform(0.6, 1.4, STRAIN_WAVES)
    phase = at @ (k * np.stack((np.cos(direction), np.sin(direction))))
    phase += rng.uniform(0.0, 2 * math.pi, STRAIN_WAVES)
    size = STRAIN * math.sqrt(2.0 / STRAIN_WAVES) / k * rng.choice((-1.0, 1.0), (2, STRAIN_WAVES))
    return np.asarray(np.sin(phase) @ size.T)


def _face(cores: NDArray[np.float64], width: int, height: int, radius_px: float) -> Sparse:
    """What a core receives: the mean over its disc, the pixels on the rim in part."""
    reach = math.ceil(radius_px + 0.5)
    window = np.arange(-reach, reach + 1)
    du, dv = (a.ravel() for a in np.meshgrid(window, window))
    u = np.rint(cores[:, :1]).astype(np.int64) + du
    v = np.rint(cores[:, 1:]).astype(np.int64) + dv
    weights = np.clip(radius_px + 0.5 - np.hypot(u - cores[:, :1], v - cores[:, 1:]), 0.0, 1.0)
    weights[(u < 0) | (v < 0) | (u >= width) | (v >= height)] = 0.0
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-9)
    return _sparse(v * width + u, weights)


def _leak(cores: NDArray[np.float64]) -> Sparse:
    """Crosstalk to the eighteen nearest neighbours; what a core keeps is what it does not lose."""
    count = 1 + NEAREST[0] + NEXT[0]
    _, neighbours = cKDTree(cores).query(cores, count)
    kept = 1.0 - NEAREST[0] * NEAREST[1] - NEXT[0] * NEXT[1] - TAIL_SHARE
    shares = np.array([kept] + [NEAREST[1]] * NEAREST[0] + [NEXT[1]] * NEXT[0])
    columns = np.asarray(neighbours, np.int64)
    return _sparse(columns, np.broadcast_to(shares, neighbours.shape))


class _Tail:
    """The exponential tail, on a grid of cells two pitches wide."""

    def __init__(self, cores: NDArray[np.float64], pitch_px: float) -> None:
        cell = 2.0 * pitch_px
        at = (cores - cores.min(axis=0)) / cell
        n = int(at.max()) + 2
        self._cell = (at.astype(np.int64) @ (n, 1)).astype(np.int64)
        self._n = n
        self._filled = np.maximum(np.bincount(self._cell, minlength=n * n), 1)
        self._size = next_fast_len(2 * n, real=True)
        d = np.minimum(np.arange(self._size), self._size - np.arange(self._size)) * cell
        spread = np.exp(-np.hypot(d[:, None], d[None, :]) / (TAIL_PITCHES * pitch_px))
        self._spread = np.fft.rfft2(TAIL_SHARE * spread / spread.sum())

    def __call__(self, cores: NDArray[np.float32]) -> NDArray[np.float32]:
        n, size = self._n, self._size
        mean = np.bincount(self._cell, cores, n * n) / self._filled
        spread = np.fft.irfft2(np.fft.rfft2(mean.reshape(n, n), (size, size)) * self._spread, (size, size))
        return np.asarray(spread[:n, :n].ravel()[self._cell], np.float32)


def _image(cores: NDArray[np.float64], width: int, height: int, spot_px: float, pitch_px: float) -> Sparse:
    """The relay: each core a Gaussian spot, integrated over the pixels."""
    reach = math.ceil(3.0 * spot_px + 0.5)
    window = np.arange(-reach, reach + 1)
    u, v = (np.rint(cores[:, k : k + 1]).astype(np.int64) + window for k in (0, 1))

    def share(pixel: NDArray[np.int64], centre: NDArray[np.float64]) -> NDArray[np.float64]:
        d = pixel - centre
        return np.asarray(ndtr((d + 0.5) / spot_px) - ndtr((d - 0.5) / spot_px))

    wu, wv = share(u, cores[:, :1]), share(v, cores[:, 1:])
    cell = pitch_px**2 * math.sqrt(0.75)
    weights = (cell * wv[:, :, None] * wu[:, None, :]).reshape(len(cores), -1)
    pixels = (v[:, :, None] * width + u[:, None, :]).reshape(len(cores), -1)
    outside = (u < 0)[:, None, :] | (u >= width)[:, None, :] | (v < 0)[:, :, None] | (v >= height)[:, :, None]
    weights[outside.reshape(weights.shape)] = 0.0
    keep = weights > 1e-3
    pixel, core = pixels[keep], np.nonzero(keep)[0]
    order = np.argsort(pixel, kind="stable")
    starts = np.zeros(width * height + 1, np.uint32)
    starts[1:] = np.cumsum(np.bincount(pixel, minlength=width * height))
    return Sparse(starts, core[order].astype(np.uint32), weights[keep][order].astype(np.float32))


def _sparse(columns: NDArray[np.int64], weights: NDArray[np.float64]) -> Sparse:
    """From (n, k) columns and weights; zeros are left out."""
    keep = weights > 0.0
    starts = np.concatenate(([0], np.cumsum(keep.sum(axis=1)))).astype(np.uint32)
    return Sparse(starts, columns[keep].astype(np.uint32), weights[keep].astype(np.float32))
