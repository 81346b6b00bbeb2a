"""A calibration as one would have it: solved from simulated board poses with noisy corners.

The true rig views a board in several poses; corners are found in both views with an error. What the solution
misses the truth by is the calibration's share of the experiments' errors.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from endo3d_core.calibration import Lens, Rig
from endo3d_core.head import Head
from endo3d_core.virtual_rig.motion import transform

POSES = 15
CORNERS = 13
"""Per side of the board; it fills nine tenths of the field."""
CORNER_NOISE_PX = 0.1
"""Per coordinate, in either view: the reprojection error that calibrations of such heads reach."""
TILT_DEG = 20.0


@lru_cache(maxsize=8)
def calibrated(head_yaml: str, seed: int = 0) -> str:
    """The head's file with the calibration that a user would have got, as text."""
    true, head = Rig.from_yaml(head_yaml), Head.from_yaml(head_yaml)
    rng = np.random.default_rng(seed)
    boards, camera, projector = [], [], []
    for _ in range(POSES):
        board, on_board = _board(true, head, rng)
        views = (true.camera.project(board), true.projector_pixel(board))
        noisy = [view + rng.normal(0.0, CORNER_NOISE_PX, view.shape) for view in views]
        boards.append(on_board.astype(np.float32))
        camera.append(noisy[0].astype(np.float32))
        projector.append(noisy[1].astype(np.float32))
    fixed = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3
    size = (true.camera.width, true.camera.height)
    _, K1, d1, K2, d2, R, t, _, _ = cv2.stereoCalibrate(
        boards, camera, projector, true.camera.K.copy(), true.camera.dist.copy(),
        true.projector.K.copy(), true.projector.dist.copy(), size, flags=fixed,
    )  # fmt: skip
    solved = Rig(
        Lens(true.camera.width, true.camera.height, *_numbers(K1, d1)),
        Lens(true.projector.width, true.projector.height, *_numbers(K2, d2)),
        *_numbers(R, t),
    )
    return solved.to_yaml() + head_yaml[head_yaml.index("\nhead:") + 1 :]


def _numbers(matrix: ArrayLike, vector: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """OpenCV's results as a matrix and as at most five numbers."""
    return np.asarray(matrix, np.float64), np.asarray(vector, np.float64).ravel()[:5]


def _board(rig: Rig, head: Head, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(n, 3) corners that both lenses see, in the camera's axes and in the board's."""
    side = 0.9 * head.field_mm / np.sqrt(2.0)
    line = np.linspace(-side / 2, side / 2, CORNERS)
    x, y = np.meshgrid(line, line)
    on_board = np.stack((x.ravel(), y.ravel(), np.zeros(x.size)), axis=-1)
    span = head.z_max_mm - head.z_min_mm
    z = rng.uniform(head.z_min_mm + 0.15 * span, head.z_max_mm - 0.15 * span)
    shift = rng.uniform(-0.15, 0.15, 2) * head.field_mm
    tilt = np.radians(rng.uniform(-TILT_DEG, TILT_DEG, 3))
    T = transform((*shift, z), tilt)
    board = on_board @ T[:3, :3].T + T[:3, 3]
    seen = np.ones(len(board), np.bool_)
    for lens, pixels, circle in (
        (rig.camera, rig.camera.project(board), head.camera_circle_px),
        (rig.projector, rig.projector_pixel(board), head.projector_circle_px),
    ):
        middle = ((lens.width - 1) / 2, (lens.height - 1) / 2)
        seen &= np.hypot(*(pixels - middle).T) < circle / 2
    return board[seen], on_board[seen]
