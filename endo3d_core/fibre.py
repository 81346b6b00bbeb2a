"""Imaging fibres: where the cores are, how much each transmits, and how much they leak into each other.

A bundle of 50 000 to 100 000 cores shows the scene through a honeycomb. A core map, found once in an image of an
even light, holds what ``fibre_operator`` needs to show the scene without it.
"""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

LIT_SHARE = 0.15
"""A core belongs to the bundle if the flat is this bright there, of its 99th percentile."""
LEAST_CORES = 100
FLAT_STEPS = 64
"""Of a stored flat per grey value: it is a mean of several images."""


@dataclass(frozen=True, slots=True)
class Crosstalk:
    """The share of its light that a core gives to others.

    The defaults are typical of bundles of 4 um pitch; a bundle's own come from its measured transfer function.
    """

    nearest: float = 0.04
    """To each of the six nearest neighbours."""
    second: float = 0.004
    """To each of the next twelve."""
    tail: float = 0.03
    """Together to all others, falling exponentially."""
    tail_pitches: float = 4.0
    """The tail's length over the cores' spacing."""


NO_CROSSTALK = Crosstalk(0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class CoreMap:
    """The cores of a bundle in a camera's image.

    Kept as an ``.npz`` file of the arrays flat (height, width) uint16 in 1/64 grey values, cores (n, 2) float32 (x,
    y) px, spacing_px () and crosstalk (4,) in the order of ``Crosstalk``.
    """

    flat: NDArray[np.float32]
    """(height, width) image of an even light, grey values."""
    cores: NDArray[np.float64]
    """(n, 2) centres (x, y), px."""
    spacing_px: float
    """Of neighbouring cores."""
    crosstalk: Crosstalk = Crosstalk()

    @classmethod
    def find(cls, flat: NDArray[np.generic], crosstalk: Crosstalk = Crosstalk()) -> CoreMap:
        """From an image of an even light (height, width), best the mean of several.

        Raises ``ValueError`` when it shows no bundle.
        """
        spacing = core_spacing(flat)
        cores = find_cores(flat, spacing)
        if len(cores) < LEAST_CORES:
            raise ValueError(f"only {len(cores)} fibre cores found; the flat image must show a lit bundle")
        return cls(flat.astype(np.float32), cores, spacing, crosstalk)

    def binned(self, factor: int) -> CoreMap:
        """The same bundle seen by a camera that bins; its cores need not be resolved any more."""
        height, width = (n // factor for n in self.flat.shape)
        bins = self.flat[: height * factor, : width * factor].reshape(height, factor, width, factor)
        cores = (self.cores + 0.5) / factor - 0.5
        return CoreMap(bins.mean(axis=(1, 3)), cores, self.spacing_px / factor, self.crosstalk)

    def to_npz(self) -> bytes:
        """The file."""
        c = self.crosstalk
        file = io.BytesIO()
        np.savez_compressed(
            file,
            flat=np.rint(np.clip(self.flat * FLAT_STEPS, 0, 65535)).astype(np.uint16),
            cores=self.cores.astype(np.float32),
            spacing_px=np.float64(self.spacing_px),
            crosstalk=np.array((c.nearest, c.second, c.tail, c.tail_pitches)),
        )
        return file.getvalue()

    @classmethod
    def from_npz(cls, file: bytes) -> CoreMap:
        """Raises ``ValueError`` when that is no core map."""
        try:
            with np.load(io.BytesIO(file), allow_pickle=False) as arrays:
                flat, cores = arrays["flat"], arrays["cores"]
                spacing, crosstalk = float(arrays["spacing_px"]), Crosstalk(*map(float, arrays["crosstalk"]))
        except (OSError, KeyError, EOFError, TypeError, ValueError) as error:
            raise ValueError(f"this is no map of fibre cores: {error}") from error
        if flat.ndim != 2 or cores.ndim != 2 or cores.shape[1] != 2:
            raise ValueError(f"this is no map of fibre cores: flat {flat.shape}, cores {cores.shape}")
        return cls(flat.astype(np.float32) / FLAT_STEPS, cores.astype(np.float64), spacing, crosstalk)


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
    """(n, 2) core centres (x, y) in px, to a fraction of a pixel, row by row, from a flat image (height, width)."""
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
