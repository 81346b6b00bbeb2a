"""What the projector can light: points elsewhere were lit by stray light, and their phase is that of its edge.

The projector's fibre shows a disc of the pattern. Light that leaks past its rim still carries fringes, which pull
points there by tens of micrometres. Along a camera ray the disc is an interval of depths, known from the calibration.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from endo3d_core.calibration import Rig
from endo3d_core.compiled import kernel
from endo3d_core.head import Head

RIM_PITCHES = 2.5
"""The disc's rim, in core spacings: so far does light of the inside reach by crosstalk and blur."""
STEP_PX, DEPTHS = 32, 64
"""The limits are computed at every so many camera pixels, linear between, and with so many depths."""
NEIGHBOUR_MM = 0.15
"""Between neighbours of the grid; more is no surface that both modes can measure."""
SUPPORT = 2
"""Neighbours of four that a point has to have within that."""


class ProjectorField:
    """Sorts out the points of one grid; all memory is taken at construction."""

    def __init__(self, limits: NDArray[np.float32], support: int = SUPPORT) -> None:
        """``limits``: ``depth_limits``. ``support``: how many of its four neighbours a point has to have within
        ``NEIGHBOUR_MM``."""
        self.limits, self.support = limits, support
        self._kept = np.zeros(self.limits.shape[1:], np.bool_)

    def keep(self, points: NDArray[np.float32], depth: NDArray[np.uint16] | None = None) -> int:
        """Points (height, width, 6) and depth map: NaN and 0 where it can't be right; returns the valid count."""
        count = _keep(points, self.limits, self.support, self._kept)
        if depth is not None:
            _blank(depth, self._kept)
        return count


def depth_limits(rig: Rig, head: Head, bin_px: int, z_min_mm: float, z_max_mm: float) -> NDArray[np.float32]:
    """(2, height, width) nearest and farthest depth that the projector lights, of a binned camera's grid."""
    height, width = rig.camera.height // bin_px, rig.camera.width // bin_px
    step = STEP_PX / bin_px
    rows, columns = (int(np.ceil(n / step)) + 1 for n in (height, width))
    v, u = np.mgrid[0:rows, 0:columns] * STEP_PX + 0.5 * (bin_px - 1)
    rays = rig.camera.ray(np.stack((u, v), axis=-1).astype(np.float64))
    depths = np.linspace(z_min_mm, z_max_mm, DEPTHS)
    middle = np.array(((rig.projector.width - 1) / 2, (rig.projector.height - 1) / 2))
    pixels = rig.projector_pixel(rays[..., None, :] * depths[:, None]) - middle
    radius = head.projector_circle_px / 2 - RIM_PITCHES * head.projector_pitch_px
    lit = np.hypot(pixels[..., 0], pixels[..., 1]) <= radius
    half = 0.5 * (depths[1] - depths[0])
    near = np.where(lit.any(axis=-1), depths[lit.argmax(axis=-1)] - half, z_max_mm + half)
    far = np.where(lit.any(axis=-1), depths[DEPTHS - 1 - lit[..., ::-1].argmax(axis=-1)] + half, z_min_mm - half)
    to_nodes = np.mgrid[0:height, 0:width].astype(np.float32) / np.float32(step)
    return np.stack([
        cv2.remap(plane.astype(np.float32), to_nodes[1], to_nodes[0], cv2.INTER_LINEAR) for plane in (near, far)
    ])  # fmt: skip


@kernel
def _keep(points: NDArray[np.float32], limits: NDArray[np.float32], support: int, kept: NDArray[np.bool_]) -> int:
    """NaN where the projector gives no light of its own, or where points stand alone; how many are left."""
    near, far, count = limits[0], limits[1], 0
    height, width = kept.shape
    most, nan, zero = np.float32(NEIGHBOUR_MM), np.float32(np.nan), np.float32(0.0)
    for v in range(height):
        for x in range(width):
            z = points[v, x, 2]
            kept[v, x] = (z >= near[v, x]) & (z <= far[v, x])
    for v in range(height if support > 0 else 0):
        for x in range(width):
            if kept[v, x]:
                z, beside = points[v, x, 2], 0
                beside += int(v > 0 and abs(points[v - 1, x, 2] - z) < most)
                beside += int(v + 1 < height and abs(points[v + 1, x, 2] - z) < most)
                beside += int(x > 0 and abs(points[v, x - 1, 2] - z) < most)
                beside += int(x + 1 < width and abs(points[v, x + 1, 2] - z) < most)
                kept[v, x] = beside >= support
    for v in range(height):
        for x in range(width):
            if kept[v, x]:
                count += 1
            else:
                points[v, x, 0] = points[v, x, 1] = points[v, x, 2] = points[v, x, 5] = nan
                points[v, x, 4] = zero
    return count


@kernel
def _blank(depth: NDArray[np.uint16], kept: NDArray[np.bool_]) -> None:
    for v in range(depth.shape[0]):
        for x in range(depth.shape[1]):
            depth[v, x] = depth[v, x] if kept[v, x] else np.uint16(0)
