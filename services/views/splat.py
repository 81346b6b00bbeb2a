"""A picture of a point cloud without a graphics card: every point is a soft disc, light shows the shape.

Two passes over the points (visibility, then blending of what lies at the front), then shading from the
blended depth alone: normals by finite differences, a key light, and darkened hollows (eye-dome lighting).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from endo3d_core.compiled import kernel

BACKGROUND = (np.array([38, 41, 48], np.float32), np.array([16, 17, 21], np.float32))
"""Top and bottom of the picture, RGB."""


@dataclass(frozen=True)
class Eye:
    """Where a picture is taken from: OpenCV's camera axes (x right, y down, z forward), perspective."""

    R: NDArray[np.float64]
    """(3, 3), world to eye."""
    position: NDArray[np.float64]
    """(3,) mm."""
    focal_px: float
    width: int
    height: int

    def project(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """(n, 3) world mm -> (n, 3): u px, v px, depth mm."""
        local = (np.asarray(points, float).reshape(-1, 3) - self.position) @ self.R.T
        depth = np.maximum(local[:, 2], 1e-6)
        u = self.focal_px * local[:, 0] / depth + self.width / 2
        v = self.focal_px * local[:, 1] / depth + self.height / 2
        return np.stack([u, v, depth], axis=1)


TILT_DEG, TURN_DEG = 52.0, 24.0
NEAREST = 0.3
"""The eye keeps this share of the points' extent away from the first of them."""


def oblique(axes: NDArray[np.floating]) -> NDArray[np.float64]:
    """(3,) direction of view onto a cloud with these principal axes: like a table seen from a chair."""
    tilt, turn = np.deg2rad([TILT_DEG, TURN_DEG])
    across = np.cos(turn) * axes[1] + np.sin(turn) * axes[0]
    return np.asarray(np.sin(tilt) * -axes[2] + np.cos(tilt) * across)


def looking(
    at: NDArray[np.floating],
    direction: NDArray[np.floating],
    up: NDArray[np.floating],
    size: tuple[int, int],
    margin: float = 0.06,
    field_deg: float = 26.0,
) -> Eye:
    """An eye that looks along ``direction`` and sees all points ``at`` (n, 3), with a ``margin`` to spare."""
    width, height = size
    forward = np.asarray(direction, float) / np.linalg.norm(direction)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    focal = max(size) / 2 / np.tan(np.deg2rad(field_deg) / 2)
    x, y, z = (np.asarray(at, float) @ R.T).T
    half = np.array([width, height]) / 2 * (1 - 2 * margin) / focal
    # each point asks for |x - cx| <= half_x (z - cz), likewise y: the tightest planes fix centre and distance
    cz = min(
        float(z.min()) - NEAREST * float(np.linalg.norm(np.ptp(at, axis=0))),  # never inside the cloud
        (np.min(x + half[0] * z) - np.max(x - half[0] * z)) / (2 * half[0]),
        (np.min(y + half[1] * z) - np.max(y - half[1] * z)) / (2 * half[1]),
    )
    cx = (np.min(x + half[0] * (z - cz)) + np.max(x - half[0] * (z - cz))) / 2
    cy = (np.min(y + half[1] * (z - cz)) + np.max(y - half[1] * (z - cz))) / 2
    return Eye(R, R.T @ np.array([cx, cy, cz]), focal, width, height)


def render(
    points: NDArray[np.floating], rgb: NDArray[np.uint8], eye: Eye, radius_mm: float
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """(height, width, 3) uint8 RGB and (height, width) float32 depth in mm, infinite where nothing is.

    points (n, 3) mm, rgb (n, 3), discs of ``radius_mm``.
    """
    uvd = eye.project(points).astype(np.float32)
    front = np.full((eye.height, eye.width), np.inf, np.float32)
    _nearest(uvd, np.float32(eye.focal_px * radius_mm), front)
    blended = np.zeros((eye.height, eye.width, 5), np.float32)
    slack = np.float32(2.0 * radius_mm)
    _blend(uvd, np.ascontiguousarray(rgb), np.float32(eye.focal_px * radius_mm), front, slack, blended)
    weight = blended[..., 4]
    seen = weight > 0
    share = np.where(seen, 1 / np.maximum(weight, 1e-9), 0)[..., None]
    depth = np.where(seen, blended[..., 3] * share[..., 0], np.inf).astype(np.float32)
    light = shade(depth, eye, radius_mm)
    colour = blended[..., :3] * share * light[..., None]
    ramp = np.linspace(0, 1, eye.height, dtype=np.float32)[:, None, None]
    behind = BACKGROUND[0] * (1 - ramp) + BACKGROUND[1] * ramp
    return np.clip(np.where(seen[..., None], colour, behind), 0, 255).astype(np.uint8), depth


def shade(depth: NDArray[np.float32], eye: Eye, scale_mm: float) -> NDArray[np.float32]:
    """(height, width) brightness from depth alone: key light from upper left, head light, dark hollows."""
    seen = np.isfinite(depth)
    filled = np.where(seen, depth, 0).astype(np.float32)
    near = max(1.0, eye.focal_px * scale_mm / float(np.median(depth[seen]))) if seen.any() else 1.0
    smooth = _masked_blur(filled, seen, 0.8 * near)
    across = smooth / eye.focal_px
    dy, dx = np.gradient(smooth)
    normal = np.stack([-dx / across.clip(1e-9), -dy / across.clip(1e-9), -np.ones_like(dx)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    key = np.array([-0.55, -0.62, -0.56], np.float32)
    lambert = np.clip(normal @ key, 0, None)
    head = np.clip(-normal[..., 2], 0, None)
    hollow = np.zeros_like(smooth)
    for reach in (2, 5, 12):
        around = _masked_blur(filled, seen, reach * near)
        hollow += np.clip((smooth - around) / (reach * scale_mm), 0, 1)
    light = (0.42 + 0.78 * lambert + 0.25 * head) * np.exp(-0.5 * hollow)
    light = 1.12 * (1.0 - np.exp(-1.55 * light))  # bright slopes keep their colour
    return np.where(seen, light, 0).astype(np.float32)


def _masked_blur(values: NDArray[np.float32], mask: NDArray[np.bool_], sigma_px: float) -> NDArray[np.float32]:
    """Gaussian mean over the pixels of the mask only; a wide one is taken on a smaller picture."""
    height, width = values.shape
    shrink = max(1, int(sigma_px / 2))
    small = (-(-width // shrink), -(-height // shrink))
    total, weight = (
        cv2.GaussianBlur(cv2.resize(plane, small, interpolation=cv2.INTER_AREA), (0, 0), sigma_px / shrink)
        for plane in (values, mask.astype(np.float32))
    )
    mean = cv2.resize(total / np.maximum(weight, 1e-6), (width, height), interpolation=cv2.INTER_LINEAR)
    return np.where(mask, mean, 0).astype(np.float32)


@kernel
def _nearest(uvd: NDArray[np.float32], reach: np.float32, front: NDArray[np.float32]) -> None:
    height, width = front.shape
    for i in range(uvd.shape[0]):
        u, v, d = uvd[i, 0], uvd[i, 1], uvd[i, 2]
        r = max(reach / d, np.float32(0.75))
        for y in range(max(0, int(v - r)), min(height, int(v + r) + 1)):
            for x in range(max(0, int(u - r)), min(width, int(u + r) + 1)):
                if (x - u) ** 2 + (y - v) ** 2 <= r * r and d < front[y, x]:
                    front[y, x] = d


@kernel
def _blend(
    uvd: NDArray[np.float32],
    rgb: NDArray[np.uint8],
    reach: np.float32,
    front: NDArray[np.float32],
    slack: np.float32,
    blended: NDArray[np.float32],
) -> None:
    height, width = front.shape
    for i in range(uvd.shape[0]):
        u, v, d = uvd[i, 0], uvd[i, 1], uvd[i, 2]
        r = max(reach / d, np.float32(0.75))
        for y in range(max(0, int(v - r)), min(height, int(v + r) + 1)):
            for x in range(max(0, int(u - r)), min(width, int(u + r) + 1)):
                square = ((x - u) ** 2 + (y - v) ** 2) / (r * r)
                if square <= 1.0 and d <= front[y, x] + slack:
                    w = (1.0 - square) ** 2 + np.float32(1e-4)
                    blended[y, x, 0] += w * rgb[i, 0]
                    blended[y, x, 1] += w * rgb[i, 1]
                    blended[y, x, 2] += w * rgb[i, 2]
                    blended[y, x, 3] += w * d
                    blended[y, x, 4] += w
