"""An analytic renderer for the decoder's tests: a plane before a head, exact to the last bit of float64."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import endo3d.deploy
from endo3d_core import patterns, triangulation
from endo3d_core.calibration import Rig

HEADS = Path(endo3d.deploy.__path__[0]) / "heads"


def head_rig(name: str = "base6_wd20") -> Rig:
    return Rig.from_yaml((HEADS / f"{name}.yaml").read_text())


def small_rig(factor: int = 2) -> Rig:
    """The same head with a camera that bins: a quarter of the pixels for quick tests."""
    rig = head_rig()
    return Rig(rig.camera.binned(factor), rig.projector, rig.R, rig.t)


@dataclass(frozen=True)
class Plane:
    """z = z0 + slope_x x + slope_y y in the camera's axes."""

    z0_mm: float = 20.0
    slope_x: float = 0.2
    slope_y: float = 0.1

    def depth(self, rays: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(self.z0_mm / (1.0 - self.slope_x * rays[..., 0] - self.slope_y * rays[..., 1]))


def render(
    rig: Rig,
    pattern: patterns.Pattern,
    surface: Plane,
    *,
    grey: float = 180.0,
    ambient: float = 0.02,
    albedo: NDArray[np.float64] | float = 1.0,
    rng: np.random.Generator | None = None,
) -> NDArray[np.uint8]:
    """(height, width) uint8: an ideal diffuse plane, the full well's shot noise if ``rng`` is given."""
    rays = rig.camera.ray(rig.camera.pixel_grid())
    lit = rig.projector_pixel(rays * surface.depth(rays)[..., None])
    n = rig.projector.width if pattern.axis == "columns" else rig.projector.height
    light = patterns.profile(pattern, triangulation.coded(lit, pattern.axis), n)
    g = grey * albedo * (ambient + (1.0 - ambient) * light)
    if rng is not None:
        g = (rng.poisson(g * 125.5) + rng.normal(0.0, 7.0, g.shape)) / 125.5
    return np.clip(np.rint(g), 0, 255).astype(np.uint8)


def field(rig: Rig, bin_px: int, axis: patterns.Axis = "columns") -> NDArray[np.bool_]:
    """Grid pixels that the fibre's circle shows, two grid pixels inside its edge."""
    grid = triangulation.grid_pixels(rig, bin_px, axis) - (rig.camera.width / 2.0, rig.camera.height / 2.0)
    return np.asarray(np.hypot(grid[..., 0], grid[..., 1]) < 0.29 * rig.camera.width)
