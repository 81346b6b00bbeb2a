"""Alignment, error measures and the text forms of trajectories."""

from __future__ import annotations

import numpy as np
import pytest

from endo3d_core import rigid, trajectory


def wander(n: int = 50) -> np.ndarray:
    rng = np.random.default_rng(3)
    poses = [np.eye(4)]
    for _ in range(n - 1):
        poses.append(poses[-1] @ rigid.exp(rng.normal(0, [0.3, 0.3, 0.1, 0.01, 0.01, 0.01])))
    return np.array(poses)


@pytest.mark.parametrize("alignment", ["rigid", "first"])
def test_a_moved_world_costs_nothing(alignment: trajectory.Alignment) -> None:
    truth = wander()
    moved = rigid.exp([5, -3, 20, 1.0, 0.4, -0.7]) @ truth
    error = trajectory.ate(moved, truth, alignment)
    assert error.max_um < 1e-6
    assert error.rms_mrad < 1e-4


def test_errors_are_in_um_and_mrad() -> None:
    truth = wander()
    wrong = truth.copy()
    wrong[:, :3, 3] += [0.003, 0, 0.004]
    assert trajectory.ate(wrong, truth, "none").rms_um == pytest.approx(5.0)
    turned = truth @ rigid.exp([0, 0, 0, 0, 0, 0.002])
    assert trajectory.ate(turned, truth, "none").rms_mrad == pytest.approx(2.0)
    assert trajectory.ate(turned, truth, "none").rms_um == pytest.approx(0.0)


def test_relative_error_sees_a_step_once() -> None:
    truth = wander()
    jumped = truth.copy()
    jumped[25:, :3, 3] += [0.01, 0, 0]
    error = trajectory.rpe(jumped, truth)
    assert error.max_um == pytest.approx(10.0)
    assert error.rms_um == pytest.approx(10.0 / np.sqrt(49))


def test_fit_rigid_recovers_the_transform() -> None:
    points = np.random.default_rng(1).normal(size=(20, 3))
    T = rigid.exp([1, 2, 3, 0.5, -1.2, 0.1])
    np.testing.assert_allclose(trajectory.fit_rigid(points, rigid.apply(T, points)), T, atol=1e-12)
    with pytest.raises(ValueError, match="three or more"):
        trajectory.fit_rigid(points[:2], points[:2])


def test_tum_round_trip() -> None:
    poses = wander(5)
    stamps = 1_700_000_000_000_000_001 + 5_813_953 * np.arange(5)
    read_stamps, read_poses = trajectory.from_tum(trajectory.to_tum(stamps, poses))
    np.testing.assert_array_equal(read_stamps, stamps)
    np.testing.assert_allclose(read_poses, poses, atol=1e-5)


def test_csv_states_the_sigma_of_each_axis() -> None:
    information = np.diag([1e4, 4e4, 1e6, 1e8, 1e8, 1e8])
    text = trajectory.to_csv([7], [np.eye(4)], [information], [10.0], ["tracking"])
    header, row = text.strip().split("\n")
    values = dict(zip(header.split(","), row.split(","), strict=True))
    assert (values["stamp_ns"], values["state"]) == ("7", "tracking")
    assert [float(values[f"sigma_{axis}_um"]) for axis in "xyz"] == pytest.approx([10.0, 5.0, 1.0])


def test_covariance_survives_an_unobserved_direction() -> None:
    direction = np.array([0.6, 0.8, 0, 0, 0, 0])
    information = 1e4 * (np.eye(6) - np.outer(direction, direction))
    covariance = trajectory.covariance(information)
    assert direction @ covariance @ direction > 1.0
    across = np.array([-0.8, 0.6, 0, 0, 0, 0])
    assert across @ covariance @ across == pytest.approx(1e-4, rel=1e-3)
