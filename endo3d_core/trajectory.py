"""Trajectories: alignment, absolute and relative errors, and the two text forms (TUM, CSV).

Definitions: Sturm et al., A benchmark for the evaluation of RGB-D SLAM systems, IROS 2012.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from endo3d_core import rigid

Alignment = Literal["rigid", "first", "none"]


@dataclass(frozen=True, slots=True)
class TrajectoryError:
    """Position and rotation errors of a trajectory against the truth."""

    rms_um: float
    mean_um: float
    max_um: float
    rms_mrad: float
    poses: int


def fit_rigid(source: ArrayLike, target: ArrayLike) -> NDArray[np.float64]:
    """T_target_source (4, 4) of least squares over point pairs, each (n, 3) (Kabsch 1976, Umeyama 1991)."""
    source, target = np.asarray(source, np.float64), np.asarray(target, np.float64)
    if source.shape != target.shape or len(source) < 3:
        raise ValueError(f"need three or more point pairs, got {source.shape} and {target.shape}")
    centre_s, centre_t = source.mean(axis=0), target.mean(axis=0)
    U, _, Vt = np.linalg.svd((target - centre_t).T @ (source - centre_s))
    T = np.eye(4)
    T[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)]) @ Vt
    T[:3, 3] = centre_t - T[:3, :3] @ centre_s
    return T


def align(estimated: ArrayLike, truth: ArrayLike, alignment: Alignment = "rigid") -> NDArray[np.float64]:
    """The estimated poses (n, 4, 4) in the truth's world.

    ``rigid`` fits all positions, with the best mean rotation between the two sets of axes (positions of a
    short hand motion alone leave the rotation badly determined); ``first`` lays the first poses on top of
    each other.
    """
    estimated, truth = np.asarray(estimated, np.float64), np.asarray(truth, np.float64)
    if estimated.shape != truth.shape or estimated.shape[1:] != (4, 4):
        raise ValueError(f"need two equal (n, 4, 4) trajectories, got {estimated.shape}, {truth.shape}")
    if alignment == "none":
        return estimated
    if alignment == "first":
        laid: NDArray[np.float64] = truth[0] @ rigid.inverse(estimated[0]) @ estimated
        return laid
    T_truth_estimated = np.eye(4)
    U, _, Vt = np.linalg.svd(np.einsum("nij,nkj->ik", truth[:, :3, :3], estimated[:, :3, :3]))
    T_truth_estimated[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)]) @ Vt
    moved = estimated[:, :3, 3] @ T_truth_estimated[:3, :3].T
    T_truth_estimated[:3, 3] = (truth[:, :3, 3] - moved).mean(axis=0)
    fitted: NDArray[np.float64] = T_truth_estimated @ estimated
    return fitted


def ate(estimated: ArrayLike, truth: ArrayLike, alignment: Alignment = "rigid") -> TrajectoryError:
    """Absolute trajectory error of T_world_camera poses, both (n, 4, 4), mm."""
    truth = np.asarray(truth, np.float64)
    return _error(align(estimated, truth, alignment), truth)


def rpe(estimated: ArrayLike, truth: ArrayLike, step: int = 1) -> TrajectoryError:
    """Relative pose error over ``step`` poses: the drift, independent of any alignment."""
    estimated, truth = np.asarray(estimated, np.float64), np.asarray(truth, np.float64)
    moved = rigid.inverse(estimated[:-step]) @ estimated[step:]
    expected = rigid.inverse(truth[:-step]) @ truth[step:]
    return _error(moved, expected)


def _error(estimated: NDArray[np.float64], truth: NDArray[np.float64]) -> TrajectoryError:
    distance_um = 1e3 * np.linalg.norm(estimated[:, :3, 3] - truth[:, :3, 3], axis=1)
    cosine = (np.einsum("nij,nij->n", estimated[:, :3, :3], truth[:, :3, :3]) - 1.0) / 2.0
    angle_mrad = 1e3 * np.arccos(np.clip(cosine, -1.0, 1.0))
    return TrajectoryError(
        rms_um=float(np.sqrt(np.mean(distance_um**2))),
        mean_um=float(distance_um.mean()),
        max_um=float(distance_um.max()),
        rms_mrad=float(np.sqrt(np.mean(angle_mrad**2))),
        poses=len(truth),
    )


def to_tum(stamps_ns: Iterable[int], poses: Iterable[NDArray[np.float64]]) -> str:
    """The text form of the TUM benchmark: ``t[s] x y z qx qy qz qw``, positions in m as its tools expect."""
    lines = ["# timestamp_s tx_m ty_m tz_m qx qy qz qw"]
    for stamp_ns, T in zip(stamps_ns, poses, strict=True):
        values = (*(1e-3 * T[:3, 3]), *rigid.quaternion(T[:3, :3]))
        lines.append(f"{_seconds(stamp_ns)} " + " ".join(f"{value:.9f}" for value in values))
    return "\n".join(lines) + "\n"


def from_tum(text: str) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Stamps (n,) ns and poses (n, 4, 4) mm from the TUM form."""
    stamps, poses = [], []
    for line in text.splitlines():
        if not line.strip() or line.startswith("#"):
            continue
        seconds, *values = line.split()
        whole, _, fraction = seconds.partition(".")
        stamps.append(int(whole) * 10**9 + int(f"{fraction:0<9.9}"))
        pose = rigid.translation([1e3 * float(value) for value in values[:3]])
        pose[:3, :3] = rigid.rotation([float(value) for value in values[3:]])
        poses.append(pose)
    return np.array(stamps, np.int64), np.array(poses).reshape(-1, 4, 4)


CSV_HEADER = "stamp_ns,x_mm,y_mm,z_mm,qx,qy,qz,qw,sigma_x_um,sigma_y_um,sigma_z_um,sigma_weak_um,state"


def to_csv(
    stamps_ns: Iterable[int],
    poses: Iterable[NDArray[np.float64]],
    informations: Iterable[NDArray[np.float64]],
    sigmas_weak_um: Iterable[float],
    states: Iterable[str],
) -> str:
    """One line per pose in mm, with the position's 1-sigma along the camera's axes."""
    lines = [CSV_HEADER]
    rows = zip(stamps_ns, poses, informations, sigmas_weak_um, states, strict=True)
    for stamp_ns, T, information, sigma_weak_um, state in rows:
        sigma_um = 1e3 * np.sqrt(np.diag(covariance(information))[:3])
        values = (*T[:3, 3], *rigid.quaternion(T[:3, :3]), *sigma_um, sigma_weak_um)
        lines.append(f"{stamp_ns}," + ",".join(f"{value:.9g}" for value in values) + f",{state}")
    return "\n".join(lines) + "\n"


def covariance(information: ArrayLike) -> NDArray[np.float64]:
    """(6, 6) covariance of an information matrix.

    A direction nothing was learnt about gets a variance of 1e12 times that of the best known one instead of
    infinity, so that the others stay usable.
    """
    information = np.asarray(information, np.float64)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    half = (scale[:, None] * vectors) / np.sqrt(np.maximum(values, 1e-12 * max(values[-1], 1e-300)))
    C: NDArray[np.float64] = half @ half.T
    return C


def _seconds(stamp_ns: int) -> str:
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"
