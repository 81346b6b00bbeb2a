"""Bundle adjustment of camera, projector, their transform and all board poses at once.

Minimises the reprojection error in both images over every parameter, with Huber weights (Triggs et al.,
Bundle adjustment: a modern synthesis, 2000). The projector's coordinate is read off where the camera found the
feature, so an error there appears in both images: the four residuals of a feature are weighted by their own
covariance, estimated from the first solution's. The covariance of the parameters is s^2 (J^T W J)^-1, so each
comes with its standard deviation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from endo3d_core.calibrating.sighting import Sighting
from endo3d_core.calibration import Lens, Rig

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Size = tuple[int, int]
"""(width, height) px."""

LENS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
RIG = ("rx", "ry", "rz", "tx", "ty", "tz")
NAMES = (
    tuple(f"camera.{n}" for n in LENS)
    + tuple(f"projector.{n}" for n in LENS)
    + tuple(f"rig.{n}" for n in RIG)
)
"""The rig's parameters; the rotation as a vector (rad), the translation in mm."""

CAMERA, PROJECTOR, BETWEEN = slice(0, 9), slice(9, 18), slice(18, 24)
POSE = 6
PER_FEATURE = 4
"""Residuals: camera x, y, projector x, y."""
WHITENINGS = 2
KEPT = 4.0
"""Standard deviations within which a residual counts for the covariance."""
HUBER = 1.345
"""Of a residual in standard deviations: 95 % efficient on normal noise."""
ITERATIONS = 60
CONVERGED = 1e-10
"""Relative decrease of the cost at which the iteration ends."""


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """A calibrated rig and how well it is known."""

    rig: Rig
    sigma: dict[str, float]
    """Standard deviation of each free parameter of ``NAMES``."""
    covariance: Matrix
    """(p, p) of the free parameters, in the order of ``sigma``."""
    poses: Matrix
    """(sightings, 6): rotation vector and translation (mm) of T_camera_board."""
    residual_px: tuple[NDArray[np.float64], ...]
    """Per sighting (n, 4): reprojection error in the camera (x, y) and in the projector (x, y)."""

    @property
    def rms_px(self) -> tuple[float, float]:
        """Root mean square of the error's length, camera and projector."""
        stacked = np.concatenate(self.residual_px)
        return _length_rms(stacked[:, :2]), _length_rms(stacked[:, 2:])

    def pose_rms_px(self, index: int) -> float:
        """The same of one sighting over both images."""
        return _length_rms(self.residual_px[index].reshape(-1, 2))


def _length_rms(error: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def solve(
    sightings: list[Sighting],
    camera_size: Size,
    projector_size: Size,
    *,
    fixed: frozenset[str] = frozenset({"camera.k3", "projector.k3"}),
) -> Solution:
    """Calibrate from at least three poses of a plane.

    ``fixed`` parameters keep their starting value (distortion terms: zero).
    Raises ``ValueError`` when the poses can't determine the rig.
    """
    if len(sightings) < 3:
        raise ValueError(
            f"{len(sightings)} poses can't calibrate two lenses; at least 3 are needed, 10..15 are good"
        )
    unknown = fixed - set(NAMES)
    if unknown:
        raise ValueError(f"no parameter is called {sorted(unknown)[0]!r}")
    parameters = _start(sightings, camera_size, projector_size)
    free = np.ones(parameters.size, bool)
    free[[NAMES.index(name) for name in fixed]] = False
    whitening = np.eye(PER_FEATURE)
    for _ in range(WHITENINGS):
        parameters = _minimise(parameters, free, sightings, whitening)
        whitening = _whitening(_linearise(parameters, sightings, np.eye(PER_FEATURE))[0])
    parameters = _minimise(parameters, free, sightings, whitening)
    residual, J = _linearise(parameters, sightings, whitening)
    weight = _huber(residual)
    J = J[:, free]
    normal = (J.T * weight) @ J
    freedom = weight.sum() - J.shape[1]
    if freedom <= 0:
        raise ValueError("there are fewer measurements than parameters; take more poses")
    try:
        scale = np.sqrt(np.diag(normal))
        inverse = np.linalg.inv(normal / np.outer(scale, scale)) / np.outer(scale, scale)
    except np.linalg.LinAlgError as error:
        raise ValueError(
            "the poses don't determine the rig; tilt the board more, in several directions"
        ) from error
    covariance = inverse * float(weight @ residual**2) / freedom
    known = int(free[: len(NAMES)].sum())
    names = [name for name, is_free in zip(NAMES, free, strict=False) if is_free]
    sigma = dict(zip(names, np.sqrt(np.diag(covariance)[:known]).tolist(), strict=True))
    return Solution(
        rig_of(parameters, camera_size, projector_size),
        sigma,
        covariance[:known, :known],
        parameters[len(NAMES) :].reshape(-1, POSE),
        _by_sighting(_linearise(parameters, sightings, np.eye(PER_FEATURE))[0], sightings),
    )


def rig_of(parameters: Vector, camera_size: Size, projector_size: Size) -> Rig:
    """The rig that the first 24 parameters describe."""
    lenses = []
    for part, size in ((parameters[CAMERA], camera_size), (parameters[PROJECTOR], projector_size)):
        lenses.append(Lens(*size, _K(part), part[4:9]))
    between = parameters[BETWEEN]
    return Rig(lenses[0], lenses[1], _rotation(between[:3]), between[3:])


def parameters_of(rig: Rig) -> Vector:
    """The inverse of ``rig_of``, (24,)."""
    lenses = [
        np.array((lens.K[0, 0], lens.K[1, 1], lens.K[0, 2], lens.K[1, 2], *lens.dist))
        for lens in (rig.camera, rig.projector)
    ]
    return np.concatenate((*lenses, _floats(cv2.Rodrigues(rig.R)[0]).ravel(), rig.t))


def _start(sightings: list[Sighting], camera_size: Size, projector_size: Size) -> Vector:
    """Each lens by Zhang's method on its own, and the transform that agrees best between them."""
    board = [s.board_mm.astype(np.float32) for s in sightings]
    flags = cv2.CALIB_FIX_K3
    lenses, poses = [], []
    for size, pixels in (
        (camera_size, [s.camera_px for s in sightings]),
        (projector_size, [s.projector_px for s in sightings]),
    ):
        seen = [p.astype(np.float32) for p in pixels]
        try:
            _, K, dist, r, t = cv2.calibrateCamera(board, seen, size, np.eye(3), np.zeros(5), flags=flags)
        except cv2.error as error:
            raise ValueError("the poses don't determine the lenses; tilt the board more") from error
        lenses.append(np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *dist.ravel()[:5]]))
        poses.append([(cv2.Rodrigues(a)[0], b.ravel()) for a, b in zip(r, t, strict=True)])
    rotations = [Rp @ Rc.T for (Rc, _), (Rp, _) in zip(*poses, strict=True)]
    U, _, Vt = np.linalg.svd(np.sum(rotations, axis=0))
    R = U @ Vt
    t = np.median([tp - R @ tc for (_, tc), (_, tp) in zip(*poses, strict=True)], axis=0)
    camera_poses = [np.concatenate((cv2.Rodrigues(Rc)[0].ravel(), tc)) for Rc, tc in poses[0]]
    return np.concatenate((*lenses, cv2.Rodrigues(R)[0].ravel(), t, *camera_poses))


def _minimise(
    parameters: Vector, free: NDArray[np.bool_], sightings: list[Sighting], whitening: Matrix
) -> Vector:
    """Levenberg-Marquardt with Marquardt's scaling, Huber weights renewed in every step."""
    damping = 1e-4
    residual, J = _linearise(parameters, sightings, whitening)
    cost = _cost(residual)
    for _ in range(ITERATIONS):
        weighted = J[:, free].T * _huber(residual)
        normal = weighted @ J[:, free]
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), weighted @ residual)
        trial = parameters.copy()
        trial[free] -= step
        trial_residual, trial_J = _linearise(trial, sightings, whitening)
        trial_cost = _cost(trial_residual)
        if trial_cost < cost:
            done = cost - trial_cost < CONVERGED * cost
            parameters, residual, J, cost = trial, trial_residual, trial_J, trial_cost
            damping = max(damping / 10, 1e-12)
            if done:
                break
        else:
            damping *= 10
            if damping > 1e8:
                break
    return parameters


def _sigma(residual: Vector) -> float:
    """Standard deviation from the median absolute residual, so that outliers don't raise it."""
    return max(1.4826 * float(np.median(np.abs(residual))), 1e-12)


def _huber(residual: Vector) -> Vector:
    ratio = np.abs(residual) / (HUBER * _sigma(residual))
    return np.asarray(1.0 / np.maximum(ratio, 1.0))


def _cost(residual: Vector) -> float:
    """Mean absolute residual past the Huber knee, square before it."""
    knee = HUBER * _sigma(residual)
    size = np.abs(residual)
    return float(np.sum(np.where(size < knee, size**2, 2 * knee * size - knee**2)))


def _whitening(residual: Vector) -> Matrix:
    """(4, 4) that makes a feature's residuals uncorrelated and of variance 1; outliers don't count."""
    features = residual.reshape(-1, PER_FEATURE)
    spread = np.maximum(1.4826 * np.median(np.abs(features), axis=0), 1e-12)
    kept = features[np.all(np.abs(features) < KEPT * spread, axis=1)] / spread
    covariance = kept.T @ kept / max(len(kept), 1) + 1e-6 * np.eye(PER_FEATURE)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)) / spread)


def _linearise(parameters: Vector, sightings: list[Sighting], whitening: Matrix) -> tuple[Vector, Matrix]:
    """Whitened residuals (predicted - seen), per feature camera x, y, projector x, y, and their Jacobian."""
    features = sum(len(s.board_mm) for s in sightings)
    residual = np.zeros((features, PER_FEATURE))
    J = np.zeros((features, PER_FEATURE, parameters.size))
    between, at = parameters[BETWEEN], 0
    for index, sighting in enumerate(sightings):
        n = len(sighting.board_mm)
        pose = slice(len(NAMES) + POSE * index, len(NAMES) + POSE * (index + 1))
        r, t = parameters[pose][:3], parameters[pose][3:]
        rows = slice(at, at + n)
        pixels, dpose, dlens = _projection(sighting.board_mm, r, t, parameters[CAMERA])
        residual[rows, :2] = pixels - sighting.camera_px
        J[rows, :2, pose], J[rows, :2, CAMERA] = dpose.reshape(n, 2, -1), dlens.reshape(n, 2, -1)

        r3, t3, *derivatives = cv2.composeRT(r, t, between[:3], between[3:])
        dr3dr1, dr3dt1, dr3dr2, dr3dt2, dt3dr1, dt3dt1, dt3dr2, dt3dt2 = derivatives
        pixels, dpose, dlens = _projection(
            sighting.board_mm, _floats(r3).ravel(), _floats(t3).ravel(), parameters[PROJECTOR]
        )
        residual[rows, 2:] = pixels - sighting.projector_px
        by_pose = dpose @ np.block([[dr3dr1, dr3dt1], [dt3dr1, dt3dt1]])
        by_rig = dpose @ np.block([[dr3dr2, dr3dt2], [dt3dr2, dt3dt2]])
        J[rows, 2:, pose], J[rows, 2:, BETWEEN] = by_pose.reshape(n, 2, -1), by_rig.reshape(n, 2, -1)
        J[rows, 2:, PROJECTOR] = dlens.reshape(n, 2, -1)
        at += n
    return (residual @ whitening.T).ravel(), np.matmul(whitening, J).reshape(-1, parameters.size)


def _projection(board_mm: Matrix, r: Vector, t: Vector, lens: Vector) -> tuple[Matrix, Matrix, Matrix]:
    """Pixels (n, 2), and their derivatives by the pose (2 n, 6) and by the lens (2 n, 9)."""
    pixels, J = cv2.projectPoints(board_mm, r, t, _K(lens), lens[4:9])
    return _floats(pixels).reshape(-1, 2), _floats(J[:, :6]), _floats(J[:, 6:15])


def _rotation(vector: Vector) -> Matrix:
    return _floats(cv2.Rodrigues(vector)[0])


def _floats(array: Any) -> NDArray[np.float64]:
    return np.asarray(array, np.float64)


def _K(lens: Vector) -> Matrix:
    return np.array([[lens[0], 0.0, lens[2]], [0.0, lens[1], lens[3]], [0.0, 0.0, 1.0]])


def _by_sighting(residual: Vector, sightings: list[Sighting]) -> tuple[NDArray[np.float64], ...]:
    ends = np.cumsum([len(s.board_mm) for s in sightings])[:-1]
    return tuple(np.split(residual.reshape(-1, PER_FEATURE), ends))
