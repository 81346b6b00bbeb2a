"""Lost triggers: found in the images, repaired, and never decoded across."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from planes import Plane, field, render, small_rig

from endo3d_core import patterns, triangulation
from endo3d_core.interleaved import Interleaved

SET = patterns.parse("interleaved f1=25")
RIG = small_rig()
TRUTH_MM = Plane().depth(RIG.camera.ray(triangulation.grid_pixels(RIG, 2, "columns")))


@pytest.fixture(scope="module")
def period() -> list[np.ndarray]:
    rng = np.random.default_rng(11)
    return [render(RIG, pattern, Plane(), rng=rng) for pattern in SET.patterns]


@pytest.fixture(scope="module")
def lookup() -> triangulation.Lookup:
    return triangulation.build(RIG, 2, 16.5, 23.5)


def worst_um(decoder: Interleaved) -> float:
    points = np.empty((300, 480, 6), np.float32)
    decoder.points(points)
    return float(1e3 * np.nanpercentile(np.abs(points[..., 2] - TRUTH_MM)[field(RIG, 2)], 99.5))


@pytest.mark.parametrize("lost", [1, 2, 3])
def test_a_lost_trigger_is_found_and_repaired(lost: int, period, lookup) -> None:  # type: ignore[no-untyped-def]
    """The camera goes on counting: labels are wrong by ``lost`` from frame 10 on."""
    decoder = Interleaved(SET, lookup, 2)
    ready = []
    for k in range(26):
        shown = k + lost if k >= 10 else k
        if decoder.push(period[shown % 4], k % 4):
            ready.append(k)
            assert worst_um(decoder) < 15.0, f"frame {k} was decoded wrongly"
    assert decoder.slots.slips == 1
    assert {7, 8, 9} <= set(ready)
    assert not set(ready) & set(range(10, 16))
    assert ready[-1] == 25
    assert max(b - a for a, b in pairwise(ready)) <= 12


def test_labels_that_are_wrong_from_the_start_are_put_right(period, lookup) -> None:  # type: ignore[no-untyped-def]
    decoder = Interleaved(SET, lookup, 2)
    ready = [decoder.push(period[(k + 1) % 4], k % 4) for k in range(40)]
    assert decoder.slots.slips == 1
    assert ready[-1]
    assert worst_um(decoder) < 15.0


def test_no_false_alarm_while_everything_is_in_order(period, lookup) -> None:  # type: ignore[no-untyped-def]
    decoder = Interleaved(SET, lookup, 2)
    ready = [decoder.push(period[k % 4], k % 4) for k in range(40)]
    assert ready == [False] * 6 + [True] * 34
    assert decoder.slots.slips == 0


def test_fast_motion_is_not_mistaken_for_a_slip(lookup) -> None:  # type: ignore[no-untyped-def]
    decoder = Interleaved(SET, lookup, 2)
    ready = [
        decoder.push(render(RIG, SET[k], Plane(20.0 + 0.06 * k), rng=np.random.default_rng(k)), k % 4)
        for k in range(12)
    ]
    assert ready == [False] * 6 + [True] * 6


def test_a_dark_scene_is_no_slip(lookup) -> None:  # type: ignore[no-untyped-def]
    decoder = Interleaved(SET, lookup, 2)
    rng = np.random.default_rng(1)
    for k in range(40):
        decoder.push(rng.integers(0, 4, (600, 960), np.uint8), k % 4)
    assert decoder.slots.slips == 0


def test_an_unknown_label_is_the_next_slot(period, lookup) -> None:  # type: ignore[no-untyped-def]
    decoder = Interleaved(SET, lookup, 2)
    ready = [decoder.push(period[k % 4], -1 if k == 4 else k % 4) for k in range(9)]
    assert ready == [False] * 6 + [True] * 3
