"""Blur that depends on depth: sigma^2 = sigma0^2 + (k dz)^2 at the object, focus bowed over the field."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from endo3d_core.calibration import Lens
from endo3d_core.compiled import kernel
from endo3d_core.head import Head

DIFFRACTION_UM = 0.35
"""sigma0 on the fibre's face: numerical aperture 0.4 at 0.53 um."""
BOW = 0.05
"""Field curvature: the focus at the field's edge is nearer by this share of the working distance."""
LEVEL_SIGMAS_PX = (0.0, 0.6, 1.0, 1.5, 2.2, 3.2, 4.5, 6.5)
"""Even blurs between which a pixel's own is interpolated, linearly in variance."""


def focus_mm(head: Head) -> float:
    """Depth at which the axes of camera and projector cross."""
    return math.hypot(head.working_distance_mm, head.base_mm / 2)


def sigma0_mm(head: Head) -> float:
    """The blur in focus, at the object."""
    return DIFFRACTION_UM * 1e-3 * head.field_mm / head.fibre_diameter_mm


def bow_mm(head: Head, lens: Lens, circle_px: float) -> float:
    """How much nearer the focus is, per squared slope of the ray."""
    return BOW * head.working_distance_mm / (circle_px / 2 / float(lens.K[0, 0])) ** 2


def parameters(lens: Lens, head: Head, circle_px: float) -> NDArray[np.float32]:
    """(5,) focal length in pixels, focus, bow, and the squares of sigma0 and its growth, mm."""
    return np.array(
        (
            lens.K[0, 0],
            focus_mm(head),
            bow_mm(head, lens, circle_px),
            sigma0_mm(head) ** 2,
            head.defocus_per_mm**2,
        ),
        np.float32,
    )


@kernel
def variances(
    parameters: NDArray[np.float32],
    rx: NDArray[np.float32],
    ry: NDArray[np.float32],
    z: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Squared sigma of the blur, in pixels, of points z (rx, ry, 1)."""
    focal_px, focus, bow, sigma0_2, per_mm_2 = (
        parameters[0],
        parameters[1],
        parameters[2],
        parameters[3],
        parameters[4],
    )
    for i in range(rx.size):
        depth = min(z[i], np.float32(1e3))
        off = depth - focus + bow * (rx[i] * rx[i] + ry[i] * ry[i])
        scale = focal_px / depth
        out[i] = (sigma0_2 + per_mm_2 * off * off) * scale * scale


def gaussian(image: NDArray[np.float32], sigma_px: float) -> NDArray[np.float32]:
    """An evenly blurred image."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE), np.float32)


def blur(image: NDArray[np.float32], variance_px2: NDArray[np.float32]) -> NDArray[np.float32]:
    """(h, w) image, each pixel blurred by its own variance."""
    top = float(variance_px2.max())
    out = np.empty_like(image)
    low, low_image = 0.0, image
    for sigma in LEVEL_SIGMAS_PX[1:]:
        high = sigma * sigma
        high_image = gaussian(image, sigma)
        _mix(low, high, low_image, high_image, variance_px2, out)
        if top <= high:
            break
        low, low_image = high, high_image
    return out


@kernel
def _mix(
    low: float,
    high: float,
    low_image: NDArray[np.float32],
    high_image: NDArray[np.float32],
    variance: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Fill the pixels whose variance lies above ``low``; the last level also takes what is beyond it."""
    a, b, v, o = low_image.reshape(-1), high_image.reshape(-1), variance.reshape(-1), out.reshape(-1)
    start, scale = np.float32(low), np.float32(1.0 / (high - low))
    one = np.float32(1.0)
    for i in range(a.size):
        share = min((v[i] - start) * scale, one)
        o[i] = a[i] + share * (b[i] - a[i]) if v[i] >= start else o[i]
