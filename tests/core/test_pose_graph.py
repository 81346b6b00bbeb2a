"""The pose graph against scipy's solver, against the truth, and with loops that are wrong."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.optimize import least_squares

from endo3d_core import rigid
from endo3d_core.pose_graph import Edge, PoseGraph

ODOMETRY = np.diag([1 / 0.02**2] * 3 + [1 / 0.002**2] * 3)
LOOP = np.diag([1 / 0.001**2] * 3 + [1 / 0.0002**2] * 3)


def circle(n: int, turns: float = 1.0) -> np.ndarray:
    """(n, 4, 4): once around, looking inwards and nodding."""
    poses = []
    for angle in np.linspace(0.0, 2 * np.pi * turns, n):
        T = np.eye(4)
        T[:3, :3] = rigid.rotation_exp([0.2 * np.sin(3 * angle), 0.1, angle])
        T[:3, 3] = 8 * np.cos(angle), 8 * np.sin(angle), np.sin(2 * angle)
        poses.append(T)
    return np.array(poses)


def drifting(truth: np.ndarray, seed: int = 3) -> PoseGraph:
    """The path as an odometry with ``ODOMETRY``'s noise would tell it."""
    rng, graph = np.random.default_rng(seed), PoseGraph()
    graph.add(truth[0], np.zeros((6, 6)))
    for before, after in itertools.pairwise(truth):
        noise = rng.normal(0.0, 1.0, 6) / np.sqrt(np.diag(ODOMETRY))
        graph.add(rigid.inverse(before) @ after @ rigid.exp(noise), ODOMETRY)
    return graph


def run(graph: PoseGraph) -> int:
    """Optimises; how many pieces that took."""
    return sum(1 for _ in graph.optimise())


def off(graph: PoseGraph, truth: np.ndarray) -> float:
    """Largest error of a position, mm."""
    return float(np.linalg.norm(graph.poses[:, :3, 3] - truth[:, :3, 3], axis=1).max())


def loop(truth: np.ndarray, i: int, j: int, wrong_by: tuple[float, ...] = (0.0,) * 6) -> Edge:
    return Edge(i, j, rigid.inverse(truth[i]) @ truth[j] @ rigid.exp(wrong_by), LOOP)


def test_the_optimum_is_scipys() -> None:
    """A small graph with contradicting loops, the weights of the loops settled: stationary for both."""
    truth, graph = circle(8), drifting(circle(8))
    graph.close(loop(truth, 0, 7, (0.002, -0.001, 0.0, 0.0, 0.0002, 0.0)))
    graph.close(loop(truth, 1, 6, (-0.001, 0.0, 0.001, 0.0, 0.0, -0.0001)))
    start = graph.poses.copy()
    edges = [*graph.path, *graph.loops]
    run(graph)

    def residuals(x: np.ndarray) -> np.ndarray:
        poses = [start[0], *(T @ rigid.exp(d) for T, d in zip(start[1:], x.reshape(-1, 6), strict=True))]
        found = []
        for k, edge in enumerate(edges):
            E = rigid.inverse(edge.T_i_j) @ rigid.inverse(poses[edge.i]) @ poses[edge.j]
            e = np.concatenate([E[:3, 3], rigid.rotation_log(E[:3, :3])])
            weight = np.sqrt(graph.trust[k - 7]) if k >= 7 else 1.0
            found.append(weight * np.linalg.cholesky(edge.information).T @ e)
        return np.concatenate(found)

    best = least_squares(residuals, np.zeros(6 * 7), method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    expected = np.array([start[0], *(T @ rigid.exp(d) for T, d in zip(start[1:], best.x.reshape(-1, 6), strict=True))])
    np.testing.assert_allclose(graph.poses, expected, atol=2e-6)


def test_a_loop_closes_a_drift_and_spreads_it() -> None:
    truth, graph = circle(60), drifting(circle(60))
    before = off(graph, truth)
    gap = np.linalg.norm(graph.poses[-1, :3, 3] - truth[-1, :3, 3])
    graph.close(loop(truth, 0, 59))
    run(graph)
    assert gap > 0.05
    assert np.linalg.norm(graph.poses[-1, :3, 3] - truth[-1, :3, 3]) < 0.002
    assert off(graph, truth) < before
    steps = rigid.inverse(graph.poses[:-1]) @ graph.poses[1:]
    true_steps = rigid.inverse(truth[:-1]) @ truth[1:]
    assert np.linalg.norm(steps[:, :3, 3] - true_steps[:, :3, 3], axis=1).max() < 0.1, "no step takes it all"


def test_without_loops_nothing_moves() -> None:
    graph = drifting(circle(20))
    before = graph.poses.copy()
    run(graph)
    np.testing.assert_allclose(graph.poses, before, atol=1e-12)


def test_a_wrong_loop_among_right_ones_is_not_believed() -> None:
    truth, graph = circle(80, turns=2.0), drifting(circle(80, turns=2.0))
    for k in range(0, 36, 4):
        graph.close(loop(truth, k, k + 40))
    graph.close(loop(truth, 10, 70, (1.5, 0.0, -0.4, 0.1, 0.0, 0.0)))
    run(graph)
    assert graph.trust[-1] < 1e-3
    assert (graph.trust[:-1] > 0.1).all()
    clean = drifting(truth)
    for k in range(0, 36, 4):
        clean.close(loop(truth, k, k + 40))
    run(clean)
    np.testing.assert_allclose(graph.poses[:, :3, 3], clean.poses[:, :3, 3], atol=0.002)


def test_poses_that_come_while_it_works_hang_on_the_corrected_end() -> None:
    truth, graph = circle(30), drifting(circle(30))
    graph.close(loop(truth, 0, 29))
    step = rigid.exp([0.3, 0.0, 0.0, 0.0, 0.0, 0.1])
    for k, _ in enumerate(graph.optimise()):
        if k == 2:
            graph.add(step, ODOMETRY)
    assert len(graph.poses) == 31
    np.testing.assert_allclose(graph.poses[30], graph.poses[29] @ step, atol=1e-12)


def test_a_long_path_comes_in_many_pieces() -> None:
    """A thousand poses: no piece is the whole work, and a loop costs a few."""
    truth, graph = circle(1000), drifting(circle(1000))
    graph.close(loop(truth, 0, 999))
    assert run(graph) > 10
    assert np.linalg.norm(graph.poses[-1, :3, 3] - truth[-1, :3, 3]) < 0.005
