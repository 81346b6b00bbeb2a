"""Scenes and motions by short texts: what they mean, and what a user is told when one is wrong."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from endo3d_core.virtual_rig import motion, scene


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("", "unknown scene"),
        ("spere r=1", "one of"),
        ("sphere radius=1", "it knows: .* r,"),
        ("sphere textur=none", "did you mean 'texture'"),
        ("sphere r=big", "not a number"),
        ("sphere r=-1", "positive"),
        ("sphere at=1,2", "3 numbers"),
        ("plane texture=wood:1", "noise:CONTRAST"),
        ("plane surface=gold", "matt or metal"),
        ("plane + ", "unknown scene"),
        ("plane tilt", "key=value"),
    ],
)
def test_a_wrong_scene_says_what_would_be_right(text: str, hint: str) -> None:
    with pytest.raises(ValueError, match=hint):
        scene.parse(text)


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("walk", "one of"),
        ("stage speed=2", "did you mean|knows"),
        ("stage along=q", "axis"),
        ("hand seed=x", "number"),
    ],
)
def test_a_wrong_motion_says_what_would_be_right(text: str, hint: str) -> None:
    with pytest.raises(ValueError, match=hint):
        motion.parse(text)


def test_bodies_are_joined_and_stand_where_they_are_told() -> None:
    what = scene.parse("plane z=22 texture=noise:0.15 + sphere r=1.5 at=1,2,19 surface=metal", 20.0)
    assert [body.kind for body in what.bodies] == ["plane", "sphere"]
    assert what.bodies[0].T_scene_body[2, 3] == 22.0
    assert tuple(what.bodies[1].T_scene_body[:3, 3]) == (1.0, 2.0, 19.0)
    assert what.bodies[1].material.specular > 0.0


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_a_hand_moves_as_hands_do(seed: int) -> None:
    """Begins at rest, drifts at some mm/s along x, trembles by 50..100 um at 8..12 Hz, turns little."""
    path = motion.parse(f"hand seed={seed}").T_scene_camera
    rate_hz = 400.0
    poses = np.stack([path(k / rate_hz) for k in range(int(26 * rate_hz))])
    assert np.array_equal(poses[0], np.eye(4))
    velocity = np.diff(poses[:, :3, 3], axis=0) * rate_hz
    assert np.linalg.norm(velocity[0]) < 0.1
    assert np.ptp(poses[:, 0, 3]) == pytest.approx(10.0, abs=0.5)
    spectrum = np.abs(np.fft.rfft(velocity[:, 0] * np.hanning(len(velocity))))
    hertz = np.fft.rfftfreq(len(velocity), 1 / rate_hz)
    assert 7.5 < hertz[3:][np.argmax(spectrum[3:] * (hertz[3:] > 3))] < 12.5
    position = np.fft.rfft(poses[400:, :3, 3], axis=0)
    position[np.fft.rfftfreq(len(poses) - 400, 1 / rate_hz) < 6] = 0
    tremor = np.fft.irfft(position, len(poses) - 400, axis=0)[400:-400]
    assert (np.abs(tremor).max(axis=0) > 0.02).all()
    # 100 um, and what the turns of the drift leave above 6 Hz.
    assert (np.abs(tremor).max(axis=0) < 0.125).all()
    angle = np.degrees(np.arccos(np.clip((np.trace(poses[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1)))
    assert angle.max() < 6.0


def test_a_motion_repeats_and_seeds_differ() -> None:
    one, same, other = (motion.parse(f"hand seed={s}").T_scene_camera(3.21) for s in (1, 1, 2))
    assert np.array_equal(one, same)
    assert not np.allclose(one, other)


def test_a_stage_moves_straight() -> None:
    path = motion.parse("stage v=10 along=0,3,4").T_scene_camera
    assert np.allclose(path(0.5)[:3, 3], (0.0, 3.0, 4.0))
    assert np.array_equal(path(0.5)[:3, :3], np.eye(3))
