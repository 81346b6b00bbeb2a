"""A pose graph along a path: consecutive poses joined by odometry, some far ones by loops that were found.

Gauss-Newton on SE(3) (Grisetti et al., A tutorial on graph-based SLAM, IEEE ITSM 2:31, 2010). Loops count by robust
weights whose scale narrows from "all believed" to ``LOOP_SCALE`` (Geman and McClure; graduated non-convexity: Yang et
al., IEEE RA-L 5:1127, 2020), so that a wrong loop that contradicts the others loses its pull instead of bending the
path.

The path makes the normal equations block tridiagonal; that part, solved exactly, preconditions conjugate gradients,
and each loop costs them about one iteration. The work comes in pieces that stay below a camera's period.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from endo3d_core import rigid
from endo3d_core.compiled import exact

Array = NDArray[np.float64]

LOOP_SCALE = 3.0
"""Robust scale of a loop's misfit, in its own sigmas."""
_NARROWING = 0.25
"""Of the squared scale, from one Gauss-Newton step to the next."""
_STEPS = 30
_CONVERGED = 1e-7
"""Largest component of a step, mm and rad, that ends the iteration."""
_CG_ACCURACY = 1e-10
"""Of the energy norm of the residual, relative to the first."""


@dataclass(frozen=True, slots=True)
class Edge:
    """What was measured between two poses."""

    i: int
    j: int
    T_i_j: Array
    """(4, 4), mm."""
    information: Array
    """(6, 6) of (translation mm, rotation rad) in the axes of j."""


class PoseGraph:
    """Poses ``T_world_node``; the first one stays where it is."""

    def __init__(self) -> None:
        self.poses: Array = np.empty((0, 4, 4))
        """(n, 4, 4) as optimised last; new ones hang on the one before."""
        self.path: list[Edge] = []
        self.loops: list[Edge] = []
        self.trust: Array = np.empty(0)
        """(loops,) 0..1: how far each loop was believed in the last optimisation."""

    def add(self, T_before_node: Array, information: Array) -> int:
        """A new pose at the end of the path, as odometry says; its number."""
        if len(self.poses) == 0:
            self.poses = np.asarray(T_before_node, np.float64)[None]
            return 0
        j = len(self.poses)
        self.path.append(Edge(j - 1, j, T_before_node, information))
        self.poses = np.concatenate([self.poses, (self.poses[-1] @ T_before_node)[None]])
        return j

    def close(self, loop: Edge) -> None:
        """Adds what a loop measured."""
        self.loops.append(loop)

    def optimise(self) -> Iterator[None]:
        """Moves ``poses`` to the optimum; poses and loops that are added meanwhile wait for the next time."""
        poses = self.poses.copy()
        n = len(poses)
        edges = [*self.path[: n - 1], *self.loops]
        first = np.array([edge.i for edge in edges], np.int64)
        second = np.array([edge.j for edge in edges], np.int64)
        measured = np.array([edge.T_i_j for edge in edges]).reshape(-1, 4, 4)
        information = np.array([edge.information for edge in edges]).reshape(-1, 6, 6)
        is_loop = np.arange(len(edges)) >= n - 1
        scale2, trust = np.inf, np.ones(len(edges))
        for _ in range(_STEPS):
            error, J_i, J_j = _linearise(poses[first], poses[second], measured)
            chi2 = np.einsum("ki,kij,kj->k", error, information, error)
            widest = float(chi2[is_loop].max(initial=0.0))
            scale2 = max(min(_NARROWING * scale2, widest), LOOP_SCALE**2)
            trust = np.where(is_loop, 1.0 / (1.0 + chi2 / scale2) ** 2, 1.0)
            yield
            weighted = trust[:, None, None] * information
            equations = _Equations(n, first, second, error, J_i, J_j, weighted)
            yield
            step = np.zeros((n, 6))
            for better in equations.solutions():
                step = better
                yield
            poses = poses @ _exponentials(step)
            if scale2 == LOOP_SCALE**2 and np.abs(step).max() < _CONVERGED:
                break
        tail = rigid.inverse(self.poses[n - 1]) @ self.poses[n:]
        self.poses = np.concatenate([poses, poses[-1] @ tail])
        self.trust = trust[is_loop]


def _linearise(X_i: Array, X_j: Array, T_i_j: Array) -> tuple[Array, Array, Array]:
    """Errors (k, 6) of edges, (translation, rotation vector) of T_i_j^-1 X_i^-1 X_j, and their Jacobians (k, 6, 6).

    The Jacobians are for motions of X_i and X_j in their own axes.
    """
    E = rigid.inverse(T_i_j) @ rigid.inverse(X_i) @ X_j
    w = Rotation.from_matrix(E[:, :3, :3]).as_rotvec()
    t = E[:, :3, 3]
    J_j = np.zeros((len(E), 6, 6))
    J_j[:, :3, :3] = E[:, :3, :3]
    J_j[:, 3:, 3:] = _inverse_jacobian(w)
    # exp(-d) T_i_j = T_i_j exp(-Ad(T_i_j^-1) d): the motion of i acts on the error from its left.
    from_left = np.zeros((len(E), 6, 6))
    from_left[:, :3, :3] = np.eye(3)
    from_left[:, :3, 3:] = -_skew(t)
    from_left[:, 3:, 3:] = _inverse_jacobian(-w)
    J_i = -from_left @ _adjoint(rigid.inverse(T_i_j))
    return np.concatenate([t, w], axis=1), J_i, J_j


def _skew(v: Array) -> Array:
    """(k, 3) -> (k, 3, 3)."""
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return out - out.transpose(0, 2, 1)


def _inverse_jacobian(w: Array) -> Array:
    """Inverse right Jacobian of SO(3), (k, 3) rad -> (k, 3, 3); to third order (errors are small)."""
    W = _skew(w)
    return np.asarray(np.eye(3) + 0.5 * W + W @ W / 12.0)


def _adjoint(T: Array) -> Array:
    """(k, 4, 4) -> (k, 6, 6), as ``rigid.adjoint``."""
    out = np.zeros((len(T), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = T[:, :3, :3]
    out[:, :3, 3:] = _skew(T[:, :3, 3]) @ T[:, :3, :3]
    return out


def _exponentials(steps: Array) -> Array:
    """(n, 6) -> (n, 4, 4): translation and rotation vector, apart."""
    out = np.tile(np.eye(4), (len(steps), 1, 1))
    out[:, :3, :3] = Rotation.from_rotvec(steps[:, 3:]).as_matrix()
    out[:, :3, 3] = steps[:, :3]
    return out


class _Equations:
    """Normal equations of a step, the first pose held."""

    def __init__(self, n: int, first: Any, second: Any, error: Array, J_i: Array, J_j: Array, weight: Array) -> None:
        WJ_i, WJ_j = weight @ J_i, weight @ J_j
        self._diagonal = np.zeros((n, 6, 6))
        np.add.at(self._diagonal, first, J_i.transpose(0, 2, 1) @ WJ_i)
        np.add.at(self._diagonal, second, J_j.transpose(0, 2, 1) @ WJ_j)
        self._right = np.zeros((n, 6))
        np.add.at(self._right, first, -np.einsum("kij,ki->kj", WJ_i, error))
        np.add.at(self._right, second, -np.einsum("kij,ki->kj", WJ_j, error))
        mixed = J_i.transpose(0, 2, 1) @ WJ_j
        mixed[first == 0] = 0.0
        self._diagonal[0], self._right[0] = np.eye(6), 0.0
        self._next = np.ascontiguousarray(mixed[: n - 1])
        self._loops = first[n - 1 :], second[n - 1 :], np.ascontiguousarray(mixed[n - 1 :])
        self._pivots = _factor(self._diagonal, self._next)

    def solutions(self) -> Iterator[Array]:
        """Better and better steps (n, 6): one iteration of preconditioned conjugate gradients each."""
        x, r = np.zeros_like(self._right), self._right.copy()
        z = _solve(self._pivots, self._next, r)
        p, energy = z.copy(), float((r * z).sum())
        enough = _CG_ACCURACY**2 * energy
        for _ in range(6 * len(self._loops[0]) + 2):
            if energy <= enough:
                break
            Ap = _times(self._diagonal, self._next, *self._loops, p)
            share = energy / float((p * Ap).sum())
            x += share * p
            r -= share * Ap
            z = _solve(self._pivots, self._next, r)
            fresh = float((r * z).sum())
            p = z + fresh / energy * p
            energy = fresh
            yield x


@exact
def _factor(diagonal: Array, after: Array) -> Array:
    """Inverse pivots (n, 6, 6) of a block tridiagonal matrix; ``after`` (n - 1, 6, 6) right of the diagonal."""
    out = np.empty_like(diagonal)
    out[0] = np.linalg.inv(diagonal[0])
    for k in range(1, diagonal.shape[0]):
        out[k] = np.linalg.inv(diagonal[k] - after[k - 1].T @ out[k - 1] @ after[k - 1])
    return out


@exact
def _solve(pivots: Array, after: Array, right: Array) -> Array:
    x = right.copy()
    n = pivots.shape[0]
    for k in range(1, n):
        x[k] -= after[k - 1].T @ (pivots[k - 1] @ x[k - 1])
    x[n - 1] = pivots[n - 1] @ x[n - 1]
    for k in range(n - 2, -1, -1):
        x[k] = pivots[k] @ (x[k] - after[k] @ x[k + 1])
    return x


@exact
def _times(diagonal: Array, after: Array, first: Any, second: Any, mixed: Array, x: Array) -> Array:
    out = np.empty_like(x)
    for k in range(x.shape[0]):
        out[k] = diagonal[k] @ x[k]
    for k in range(x.shape[0] - 1):
        out[k] += after[k] @ x[k + 1]
        out[k + 1] += after[k].T @ x[k]
    for k in range(first.size):
        out[first[k]] += mixed[k] @ x[second[k]]
        out[second[k]] += mixed[k].T @ x[first[k]]
    return out
