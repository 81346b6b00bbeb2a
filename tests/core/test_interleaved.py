"""The continuous mode on planes, still and moving."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from planes import Plane, field, head_rig, render, small_rig

from endo3d_core import patterns, triangulation
from endo3d_core.interleaved import FRAMES, Form, Interleaved

SET = patterns.parse("interleaved f1=25")


def decode(form: Form, axial_um: float, *, texture: bool = False, noise: bool = True, rng_seed: int = 1):  # type: ignore[no-untyped-def]
    """(depth error mm, coverage) over the fibre's field of the last window of eight frames."""
    rig, rng = small_rig(), np.random.default_rng(rng_seed)
    decoder = Interleaved(SET, triangulation.build(rig, 2, 16.5, 23.5), 2, form=form)
    albedo = (
        np.where(rng.random((600, 960)) > 0.5, 0.5, 1.0).repeat(24, 0).repeat(24, 1)[:600, :960] if texture else 1.0
    )
    for k in range(8):
        surface = Plane(20.0 + axial_um * 1e-3 * k)
        decoder.push(render(rig, SET[k], surface, albedo=albedo, rng=rng if noise else None), k % 4)
    points = np.empty((300, 480, 6), np.float32)
    decoder.points(points)
    rays = rig.camera.ray(triangulation.grid_pixels(rig, 2, "columns"))
    truth = Plane(20.0 + axial_um * 1e-3 * (7 - decoder.latency)).depth(rays)
    error = (points[..., 2] - truth)[field(rig, 2)]
    return error[np.isfinite(error)], np.isfinite(error).mean()


@pytest.mark.parametrize("form", FRAMES)
def test_a_still_plane_is_within_three_micrometres(form: Form) -> None:
    error, coverage = decode(form, 0.0)
    assert coverage > 0.99
    assert np.sqrt(np.mean(error**2)) < 3e-3


@pytest.mark.parametrize("form", ["five", "reuse"])
@pytest.mark.parametrize("axial_um", [10.0, 20.0, 40.0, 80.0])
def test_hand_speed_makes_no_wrong_fringe_order(form: Form, axial_um: float) -> None:
    """A wrong order is 1.6 mm away; the published form has 63 % of them at 80 um per frame."""
    error, coverage = decode(form, axial_um)
    assert coverage > 0.9
    assert np.abs(error).max() < 0.05


def test_the_published_form_breaks_at_hand_speed_and_the_others_exist_for_that() -> None:
    error, _ = decode("three", 80.0)
    assert np.mean(np.abs(error) > 0.5) > 0.1


def test_fixed_texture_divides_out() -> None:
    error, coverage = decode("reuse", 0.0, texture=True)
    assert coverage > 0.97
    assert np.sqrt(np.mean(error**2)) < 5e-3


def test_a_slot_out_of_turn_starts_a_new_window() -> None:
    rig = small_rig(4)
    decoder = Interleaved(patterns.parse("interleaved f1=12"), triangulation.build(rig, 2, 16.5, 23.5), 2)
    image = np.full((300, 480), 100, np.uint8)
    ready = [decoder.push(image, k % 4) for k in range(9)]
    assert ready == [False] * 6 + [True] * 3
    assert not decoder.push(image, 3)
    assert [decoder.push(image, k % 4) for k in range(6)] == [False] * 5 + [True]


def test_light_that_is_not_there_makes_no_points() -> None:
    rig = small_rig(4)
    decoder = Interleaved(patterns.parse("interleaved f1=12"), triangulation.build(rig, 2, 16.5, 23.5), 2)
    rng = np.random.default_rng(2)
    for k in range(7):
        decoder.push(rng.integers(0, 3, (300, 480), np.uint8), k % 4)
    points = np.empty((150, 240, 6), np.float32)
    assert decoder.points(points) == 0
    assert np.isnan(points[..., :3]).all()


def test_any_start_slot_gives_the_same_plane() -> None:
    """The period is cyclic: the window may start anywhere."""
    rig = small_rig()
    lookup = triangulation.build(rig, 2, 16.5, 23.5)
    depths = []
    for start in range(4):
        decoder = Interleaved(SET, lookup, 2)
        for k in range(start, start + 7):
            decoder.push(render(rig, SET[k], Plane()), k % 4)
        points = np.empty((300, 480, 6), np.float32)
        decoder.points(points)
        depths.append(points[..., 2][field(rig, 2)])
    np.testing.assert_allclose(depths[1:], [depths[0]] * 3, atol=0.012)


@pytest.fixture(scope="module")
def full_size() -> list[np.ndarray]:
    return [render(head_rig(), pattern, Plane()) for pattern in SET.patterns]


@pytest.mark.parametrize(("bin_px", "fit"), [(4, True), (1, False)])
def test_full_resolution_camera(full_size: list[np.ndarray], bin_px: int, fit: bool) -> None:
    """Points, xyz and 16-bit depth tell the same; without the fit every camera pixel gets a depth."""
    rig = head_rig()
    lookup = triangulation.build(rig, bin_px, 16.5, 23.5)
    decoder = Interleaved(SET, lookup, bin_px, fit=fit)
    for k in range(7):
        decoder.push(full_size[k % 4], k % 4)
    shape = (lookup.height, lookup.width)
    points, xyz = np.empty((*shape, 6), np.float32), np.empty((*shape, 3), np.float32)
    depth = np.empty(shape, np.uint16)
    valid = decoder.decode(triangulation.output(points, xyz, depth, scale_mm=1.1e-4, offset_mm=16.49))
    truth = Plane().depth(rig.camera.ray(triangulation.grid_pixels(rig, bin_px, "columns")))
    error = (points[..., 2] - truth)[field(rig, bin_px)]
    assert np.isfinite(error).mean() > 0.97
    assert np.sqrt(np.nanmean(error**2)) < 3e-3
    assert valid == np.isfinite(xyz[..., 2]).sum()
    assert np.array_equal(xyz, points[..., :3], equal_nan=True)
    z = np.where(depth > 0, 16.49 + 1.1e-4 * depth, np.nan)
    np.testing.assert_allclose(z, points[..., 2], atol=0.6e-4)


def test_a_step_takes_no_memory() -> None:
    """Frame after frame: what a step takes it gives back, and no plane of the grid is among it."""
    rig = small_rig(4)
    decoder = Interleaved(patterns.parse("interleaved f1=12"), triangulation.build(rig, 2, 16.5, 23.5), 2)
    rng, out = np.random.default_rng(5), np.empty((150, 240, 6), np.float32)
    images = rng.integers(90, 110, (4, 300, 480), np.uint8)

    def steps(first: int, count: int) -> None:
        for k in range(first, first + count):
            if decoder.push(images[k % 4], k % 4):
                decoder.points(out)

    steps(0, 40)
    tracemalloc.start()
    try:
        steps(40, 20)
        tracemalloc.reset_peak()
        before, _ = tracemalloc.get_traced_memory()
        steps(60, 20)
        after, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    plane_bytes = 150 * 240
    assert peak - before < plane_bytes
    assert after - before < plane_bytes
