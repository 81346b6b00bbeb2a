"""Rigid transforms against scipy and against their own definitions."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from endo3d_core import rigid

TWISTS = st.tuples(*[st.floats(-3, 3)] * 3, *[st.floats(-1.8, 1.8)] * 3).map(np.array)


@given(TWISTS)
def test_exp_is_the_matrix_exponential_and_log_inverts_it(twist: np.ndarray) -> None:
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = rigid.skew(twist[3:]), twist[:3]
    T = rigid.exp(twist)
    np.testing.assert_allclose(T, expm(generator), atol=1e-9)
    if np.linalg.norm(twist[3:]) < 3.1:
        np.testing.assert_allclose(rigid.log(T), twist, atol=1e-7)


@given(TWISTS, TWISTS)
def test_adjoint_moves_twists_between_frames(a: np.ndarray, b: np.ndarray) -> None:
    T = rigid.exp(a)
    np.testing.assert_allclose(
        rigid.exp(rigid.adjoint(T) @ (0.1 * b)), T @ rigid.exp(0.1 * b) @ rigid.inverse(T), atol=1e-9
    )


@given(st.tuples(*[st.floats(-3.1415, 3.1415)] * 3).map(np.array))
def test_quaternions_agree_with_scipy(w: np.ndarray) -> None:
    R = Rotation.from_rotvec(w)
    q = rigid.quaternion(R.as_matrix())
    expected = R.as_quat()
    np.testing.assert_allclose(np.abs(q @ expected), 1.0, atol=1e-12)
    np.testing.assert_allclose(rigid.rotation(q), R.as_matrix(), atol=1e-9)


def test_orthonormal_repairs_rounding() -> None:
    T = rigid.exp([1, 2, 3, 0.3, -0.2, 0.1])
    rough = T + 1e-7 * np.random.default_rng(0).standard_normal((4, 4))
    repaired = rigid.orthonormal(rough)
    np.testing.assert_allclose(repaired[:3, :3] @ repaired[:3, :3].T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(repaired, T, atol=1e-6)


def test_interpolation_ends_and_middle() -> None:
    a, b = rigid.exp([1, 0, 0, 0, 0, 0.2]), rigid.exp([0, 1, 0, 0.3, 0, 0])
    np.testing.assert_allclose(rigid.interpolate(a, b, 0.0), a, atol=1e-12)
    np.testing.assert_allclose(rigid.interpolate(a, b, 1.0), b, atol=1e-12)
    half = rigid.inverse(a) @ rigid.interpolate(a, b, 0.5)
    np.testing.assert_allclose(half @ half, rigid.inverse(a) @ b, atol=1e-12)
