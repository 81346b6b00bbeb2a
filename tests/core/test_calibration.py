"""Lenses against OpenCV, and the calibration file against itself."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from endo3d_core.calibration import Lens, Rig

K = np.array([[1991.0, 0.0, 960.0], [0.0, 1988.0, 600.0], [0.0, 0.0, 1.0]])
coefficient = st.floats(-0.15, 0.15)
small = st.floats(-1e-3, 1e-3)


def lens(dist: tuple[float, ...] = (-0.12, 0.02, 5e-4, -7e-4, 0.01)) -> Lens:
    return Lens(1920, 1200, K, np.array(dist))


def test_projection_is_opencvs() -> None:
    points = np.random.default_rng(1).uniform((-5, -3, 15), (5, 3, 25), (500, 3))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, lens().dist)
    np.testing.assert_allclose(lens().project(points), expected[:, 0], atol=1e-9)


@given(k1=coefficient, k2=st.floats(-0.02, 0.02), p1=small, p2=small)
def test_undistortion_inverts_distortion_over_the_whole_image(k1: float, k2: float, p1: float, p2: float) -> None:
    some = lens((k1, k2, p1, p2, 0.0))
    pixels = some.pixel_grid()[::150, ::160]
    np.testing.assert_allclose(some.project(17.0 * some.ray(pixels)), pixels, atol=1e-8)


def test_where_the_model_folds_over_the_ray_is_nan() -> None:
    folding = lens((-2.0, 0.0, 0.0, 0.0, 0.0))
    assert np.isnan(folding.ray([1919.0, 1199.0])).any()


def test_nothing_behind_the_lens_has_a_pixel() -> None:
    assert np.isnan(lens().project([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0]])).all()


def test_a_binned_lens_sees_the_centres_of_its_bins() -> None:
    """The centre of a 4x4 bin (i, j) is pixel (4 i + 1.5, 4 j + 1.5)."""
    binned = lens().binned(4)
    assert (binned.width, binned.height) == (480, 300)
    grid = binned.pixel_grid()[::50, ::60]
    np.testing.assert_allclose(binned.ray(grid), lens().ray(4 * grid + 1.5), atol=1e-12)


def make_rig() -> Rig:
    R, _ = cv2.Rodrigues(np.array([0.01, -0.298, 0.003]))
    return Rig(lens(), Lens(1920, 1080, K, np.zeros(5)), R, np.array([-6.0, 1e-7, 1 / 3]))


def test_yaml_round_trip_keeps_every_bit() -> None:
    rig = make_rig()
    again = Rig.from_yaml(rig.to_yaml() + "head:\n  base_mm: 6\n")
    for ours, theirs in ((rig.camera, again.camera), (rig.projector, again.projector)):
        assert (ours.width, ours.height) == (theirs.width, theirs.height)
        np.testing.assert_array_equal(ours.K, theirs.K)
        np.testing.assert_array_equal(ours.dist, theirs.dist)
    np.testing.assert_array_equal(rig.R, again.R)
    np.testing.assert_array_equal(rig.t, again.t)


def test_the_projector_sees_its_own_centre_at_the_origin() -> None:
    rig = make_rig()
    np.testing.assert_allclose(rig.to_projector(rig.projector_centre_mm), np.zeros(3), atol=1e-12)
    point = np.array([0.3, -0.2, 20.0])
    np.testing.assert_allclose((rig.T_projector_camera @ [*point, 1.0])[:3], rig.to_projector(point))


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda text: text.replace("camera:", "kamera:"), "no 'camera'"),
        (lambda text: text.replace("  width: 1920\n", "", 1), "camera has no 'width'"),
        (lambda text: text.replace("R: [", "R: [9, "), "R must be 9"),
        (lambda text: "- a list", "sections camera"),
        (lambda text: "camera: [", "not YAML"),
    ],
)
def test_a_wrong_file_says_what_is_wrong(edit, message) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=message):
        Rig.from_yaml(edit(make_rig().to_yaml()))
