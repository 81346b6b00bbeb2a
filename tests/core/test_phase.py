"""Fast phase arithmetic against libm."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from endo3d_core.phase import angle, cos_sin, reciprocal, root, wrap

single = st.floats(-1e4, 1e4, width=32)


@given(y=single, x=single)
def test_angle_is_atan2(y: float, x: float) -> None:
    if np.hypot(x, y) < 1e-20:
        return
    off = angle(np.float32(y), np.float32(x)) - np.arctan2(y, x)
    assert abs((off + np.pi) % (2 * np.pi) - np.pi) < 1.3e-5


def test_angle_keeps_nan_and_is_zero_at_the_origin() -> None:
    assert np.isnan(angle(np.float32(np.nan), np.float32(1.0)))
    assert angle(np.float32(0.0), np.float32(0.0)) == 0.0


@given(phase=st.floats(-500.0, 500.0, width=32))
def test_wrap_changes_whole_turns_only(phase: float) -> None:
    wrapped = float(wrap(np.float32(phase)))
    assert abs(wrapped) <= np.pi + 1e-4
    turns = (phase - wrapped) / (2 * np.pi)
    assert abs(turns - round(turns)) < 2e-5


@given(phase=st.floats(-500.0, 500.0, width=32))
def test_cos_sin_is_cos_and_sin(phase: float) -> None:
    c, s = cos_sin(np.float32(phase))
    assert abs(c - np.cos(phase)) < 5e-5
    assert abs(s - np.sin(phase)) < 5e-5


@given(x=st.floats(2.0**-99, 2.0**99, width=32))
def test_reciprocal_and_root_without_a_division(x: float) -> None:
    assert abs(reciprocal(np.float32(x)) * x - 1.0) < 3e-7
    assert abs(reciprocal(np.float32(-x)) * x + 1.0) < 3e-7
    assert abs(root(np.float32(x)) / np.sqrt(x) - 1.0) < 6e-6


def test_the_root_of_nothing_is_nothing() -> None:
    assert root(np.float32(0.0)) == 0.0
    assert np.isnan(root(np.float32(np.nan)))
    assert np.isnan(reciprocal(np.float32(np.nan)))
