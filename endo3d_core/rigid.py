"""Rigid transforms: 4x4 matrices ``T_a_b`` that map coordinates of frame b into frame a.

Twists are (6,) arrays of (translation mm, rotation rad). Formulas: Barfoot, State Estimation for
Robotics (2017), chapter 7.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

_SMALL_RAD = 1e-6
"""Below this angle the series replaces the closed form; the next term is under 1e-13."""


def skew(v: ArrayLike) -> NDArray[np.float64]:
    """(3,) -> (3, 3) with ``skew(a) @ b == cross(a, b)``."""
    x, y, z = np.asarray(v, np.float64)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotation_exp(w: ArrayLike) -> NDArray[np.float64]:
    """Rotation vector (3,) rad -> (3, 3) rotation (Rodrigues)."""
    w = np.asarray(w, np.float64)
    angle = float(np.linalg.norm(w))
    W = skew(w)
    if angle < _SMALL_RAD:
        return np.eye(3) + W + 0.5 * W @ W
    R: NDArray[np.float64] = np.eye(3) + np.sin(angle) / angle * W + (1.0 - np.cos(angle)) / angle**2 * W @ W
    return R


def rotation_log(R: ArrayLike) -> NDArray[np.float64]:
    """(3, 3) rotation -> rotation vector (3,) rad, of length <= pi."""
    x, y, z, w = quaternion(R)
    sine = float(np.sqrt(x * x + y * y + z * z))
    scale = 2.0 if sine < _SMALL_RAD else 2.0 * float(np.arctan2(sine, w)) / sine
    return scale * np.array([x, y, z])


def _left_jacobian(w: NDArray[np.float64]) -> NDArray[np.float64]:
    angle = float(np.linalg.norm(w))
    W = skew(w)
    if angle < _SMALL_RAD:
        return np.eye(3) + 0.5 * W + W @ W / 6.0
    cubic: NDArray[np.float64] = (angle - np.sin(angle)) / angle**3 * W @ W
    quadratic: NDArray[np.float64] = np.eye(3) + (1.0 - np.cos(angle)) / angle**2 * W
    return quadratic + cubic


def exp(twist: ArrayLike) -> NDArray[np.float64]:
    """Twist (6,) -> (4, 4)."""
    twist = np.asarray(twist, np.float64)
    T = np.eye(4)
    T[:3, :3] = rotation_exp(twist[3:])
    T[:3, 3] = _left_jacobian(twist[3:]) @ twist[:3]
    return T


def log(T: ArrayLike) -> NDArray[np.float64]:
    """(4, 4) -> twist (6,); the inverse of ``exp``."""
    T = np.asarray(T, np.float64)
    w = rotation_log(T[:3, :3])
    return np.concatenate([np.linalg.solve(_left_jacobian(w), T[:3, 3]), w])


def inverse(T: ArrayLike) -> NDArray[np.float64]:
    """The inverse of a rigid transform (4, 4), or of a stack (..., 4, 4)."""
    T = np.asarray(T, np.float64)
    out = np.zeros_like(T)
    out[..., :3, :3] = np.swapaxes(T[..., :3, :3], -1, -2)
    out[..., :3, 3] = -np.einsum("...ij,...j->...i", out[..., :3, :3], T[..., :3, 3])
    out[..., 3, 3] = 1.0
    return out


def adjoint(T: ArrayLike) -> NDArray[np.float64]:
    """(6, 6) with ``exp(adjoint(T) @ twist) == T @ exp(twist) @ inverse(T)``."""
    T = np.asarray(T, np.float64)
    A = np.zeros((6, 6))
    A[:3, :3] = A[3:, 3:] = T[:3, :3]
    A[:3, 3:] = skew(T[:3, 3]) @ T[:3, :3]
    return A


def translation(v: ArrayLike) -> NDArray[np.float64]:
    """(3,) mm -> (4, 4)."""
    T = np.eye(4)
    T[:3, 3] = v
    return T


def apply(T: ArrayLike, points: ArrayLike) -> NDArray[np.float64]:
    """Points (..., 3) of frame b in frame a."""
    T = np.asarray(T, np.float64)
    moved: NDArray[np.float64] = np.asarray(points, np.float64) @ T[:3, :3].T + T[:3, 3]
    return moved


def orthonormal(T: ArrayLike) -> NDArray[np.float64]:
    """The nearest rigid transform: undoes the rounding of many products."""
    T = np.array(T, np.float64)
    U, _, Vt = np.linalg.svd(T[:3, :3])
    T[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    T[3] = 0.0, 0.0, 0.0, 1.0
    return T


def quaternion(R: ArrayLike) -> NDArray[np.float64]:
    """(3, 3) rotation -> unit quaternion (4,) x y z w, w >= 0 (Bar-Itzhack, 2000: good at any angle)."""
    R = np.asarray(R, np.float64)
    K = np.empty((4, 4))
    K[:3, :3] = R + R.T - np.trace(R) * np.eye(3)
    K[3, :3] = K[:3, 3] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    K[3, 3] = np.trace(R)
    q: NDArray[np.float64] = np.linalg.eigh(K)[1][:, -1]
    return -q if q[3] < 0 else q


def rotation(q: ArrayLike) -> NDArray[np.float64]:
    """Quaternion (4,) x y z w, any length -> (3, 3)."""
    q = np.asarray(q, np.float64)
    x, y, z, w = q / np.linalg.norm(q)
    v = skew([x, y, z])
    R: NDArray[np.float64] = np.eye(3) + 2.0 * w * v + 2.0 * v @ v
    return R


def interpolate(T_a: ArrayLike, T_b: ArrayLike, share: float) -> NDArray[np.float64]:
    """The pose at ``share`` of the way from a to b, along the constant twist."""
    T_a, T_b = np.asarray(T_a, np.float64), np.asarray(T_b, np.float64)
    between: NDArray[np.float64] = T_a @ exp(share * log(inverse(T_a) @ T_b))
    return between
