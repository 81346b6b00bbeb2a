"""What surfaces look like: albedo, texture and a specular lobe."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from endo3d_core.compiled import kernel

TILE_PX = 1024


@dataclass(frozen=True)
class Texture:
    """A periodic pattern of relative reflectivity, painted along the body's x and y (and sheared over z)."""

    kind: str = "none"
    """``none``, ``noise`` or ``checker``."""
    contrast: float = 0.0
    """noise: standard deviation; checker: half the difference. Relative to the albedo."""
    size_mm: float = 0.15
    """noise: correlation length; checker: side of a square."""

    @property
    def tile_mm(self) -> float:
        return 8.192 if self.kind == "noise" else 8.0 * self.size_mm

    def tile(self) -> NDArray[np.float32]:
        """(TILE_PX, TILE_PX) float32 with mean 1."""
        return _tile(self)


@dataclass(frozen=True)
class Material:
    """Diffuse reflection plus a specular lobe (Schlick's rational form of Phong's)."""

    albedo: float = 0.7
    texture: Texture = Texture()
    specular: float = 0.0
    """Height of the lobe beside a white diffuse surface's 1."""
    gloss: float = 30.0
    """Phong's exponent."""


METAL = {"albedo": 0.35, "specular": 2.0, "gloss": 30.0}
"""A matt-ground technical metal surface: weak diffuse share, a lobe of about 15 degrees."""


@lru_cache(maxsize=16)
def _tile(texture: Texture) -> NDArray[np.float32]:
    if texture.kind == "checker":
        squares = np.arange(TILE_PX) * 8 // TILE_PX
        sign = 1.0 - 2.0 * ((squares[:, None] + squares[None, :]) % 2)
        return (1.0 + texture.contrast * sign).astype(np.float32)
    rng = np.random.default_rng(0)
    f = np.fft.fftfreq(TILE_PX, texture.tile_mm / TILE_PX)
    # White noise under a Gaussian of the wanted correlation length, with a tail of finer grain.
    k2 = f[:, None] ** 2 + f[None, : TILE_PX // 2 + 1] ** 2
    spectrum = np.exp(-2.0 * (np.pi * texture.size_mm) ** 2 * k2) + 0.2 * np.exp(
        -0.5 * (np.pi * texture.size_mm) ** 2 * k2
    )
    noise = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((TILE_PX, TILE_PX))) * spectrum, (TILE_PX, TILE_PX))
    noise /= noise.std()
    return np.clip(1.0 + texture.contrast * noise, 0.05, 1.95).astype(np.float32)


@kernel
def paint(
    T: NDArray[np.float32],
    tile: NDArray[np.float32],
    tiles_per_mm: np.float32,
    albedo: np.float32,
    index: np.uint8,
    body: NDArray[np.uint8],
    rx: NDArray[np.float32],
    ry: NDArray[np.float32],
    z: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Albedo times texture where a ray meets the body ``index``; ``T`` = T_body_camera."""
    size = np.float32(tile.shape[0])
    mask = np.uint32(tile.shape[0] - 1)
    flat = tile.reshape(-1)
    width, one = np.uint32(tile.shape[0]), np.uint32(1)
    # Far from zero, so that truncation rounds down everywhere.
    offset = np.float32(64.0)
    for i in range(rx.size):
        depth = min(z[i], np.float32(1000.0))
        x = (T[0, 0] * rx[i] + T[0, 1] * ry[i] + T[0, 2]) * depth + T[0, 3]
        y = (T[1, 0] * rx[i] + T[1, 1] * ry[i] + T[1, 2]) * depth + T[1, 3]
        h = (T[2, 0] * rx[i] + T[2, 1] * ry[i] + T[2, 2]) * depth + T[2, 3]
        u = ((x + np.float32(0.7) * h) * tiles_per_mm + offset) * size
        v = ((y + np.float32(0.4) * h) * tiles_per_mm + offset) * size
        iu, iv = np.uint32(u), np.uint32(v)
        fu, fv = u - np.float32(iu), v - np.float32(iv)
        u0, u1 = iu & mask, (iu + one) & mask
        v0, v1 = (iv & mask) * width, ((iv + one) & mask) * width
        a = flat[v0 + u0] + fu * (flat[v0 + u1] - flat[v0 + u0])
        b = flat[v1 + u0] + fu * (flat[v1 + u1] - flat[v1 + u0])
        out[i] = albedo * (a + fv * (b - a)) if body[i] == index else out[i]
