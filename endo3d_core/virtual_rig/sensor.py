"""The camera's sensor: photons to grey values (photon-transfer model of EMVA 1288)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d_core.compiled import kernel


@dataclass(frozen=True, slots=True)
class Sensor:
    """Sony IMX174 as in the GS3-U3-23S6M; ``flux`` is the lamp's and the optics' part."""

    full_well_e: float = 32_000.0
    read_noise_e: float = 7.0
    bits: int = 8
    """8, 12, or 16 for steps too fine to matter."""
    flux_e_per_ms: float = 2_000.0
    """Of a white diffuse surface, upright, fully lit, at the working distance, in the middle of the field.

    Set as an operator would: at 132 Hz the brightest cores of a matt surface (albedo 0.7) stay below the full
    well; a core's peak is 2.4 times the mean."""

    @property
    def electrons_per_grey(self) -> float:
        return self.full_well_e / float(2**self.bits - 1)

    @property
    def dtype(self) -> type[np.uint8] | type[np.uint16]:
        return np.uint8 if self.bits == 8 else np.uint16


QUANTILES = 4096


@lru_cache(maxsize=1)
def quantiles() -> NDArray[np.float32]:
    """(QUANTILES,) evenly likely normal deviates; the sum of two draws has variance 1."""
    from scipy.special import ndtri  # here: importing it costs more than everything else of this module

    q = ndtri((np.arange(QUANTILES) + 0.5) / QUANTILES)
    return np.asarray(q / q.std() / math.sqrt(2.0), np.float32)


def develop(
    sensor: Sensor,
    electrons: NDArray[np.float32],
    where: NDArray[np.uint32],
    number: int,
    noise: bool,
    out: NDArray[Any],
) -> None:
    """Grey values of n pixels with these mean ``electrons`` into the image ``out`` at flat index ``where``.

    ``number`` seeds the noise: equal numbers give equal frames.
    """
    seed = np.uint32((number * 2_654_435_761 + 0x9E3779B9) & 0xFFFF_FFFF)
    _expose(
        electrons,
        where,
        seed,
        np.float32(sensor.read_noise_e**2 if noise else 0.0),
        np.float32(noise),
        np.float32(sensor.full_well_e),
        np.float32(1.0 / sensor.electrons_per_grey),
        quantiles(),
        out.reshape(-1),
    )


@kernel
def _expose(
    electrons: NDArray[np.float32],
    where: NDArray[np.uint32],
    seed: np.uint32,
    noise_e2: np.float32,
    shot: np.float32,
    full_well: np.float32,
    per_electron: np.float32,
    normal: NDArray[np.float32],
    out: NDArray[Any],
) -> None:
    """Above some ten electrons a Poisson number is a normal one to within Mono8's step of 125.

    ``shot`` (1 or 0) switches the shot noise, ``noise_e2`` is the read noise squared.
    """
    zero, half = np.float32(0.0), np.float32(0.5)
    low, shift = np.uint32(QUANTILES - 1), np.uint32(16)
    for i in range(electrons.size):
        # lowbias32, a bijective hash of the counter: white over pixels and, through the seed, over frames.
        x = np.uint32(where[i] ^ seed)
        x = np.uint32(x ^ (x >> np.uint32(16)))
        x = np.uint32(x * np.uint32(0x7FEB352D))
        x = np.uint32(x ^ (x >> np.uint32(15)))
        x = np.uint32(x * np.uint32(0x846CA68B))
        x = np.uint32(x ^ (x >> np.uint32(16)))
        mean = electrons[i]
        deviate = normal[x & low] + normal[(x >> shift) & low]
        e = mean + deviate * np.float32(math.sqrt(shot * max(mean, zero) + noise_e2))
        e = min(max(e, zero), full_well)
        out[where[i]] = np.uint16(e * per_electron + half)
