"""A reader's merged map against a plain dictionary."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from endo3d.schemas.messages import MapDelta
from endo3d.services.views.merged import MergedMap
from endo3d_core.merging import MAP_POINT

Key = tuple[int, int, int]
keys = st.tuples(*[st.integers(-3, 3)] * 3)
deltas = st.lists(
    st.tuples(
        st.lists(keys, max_size=6, unique=True),
        st.lists(keys, max_size=3, unique=True),
        st.booleans() | st.just(False),
        st.booleans(),
    ),
    max_size=12,
)


def delta_of(number: int, changed: list[Key], removed: list[Key], reset: bool) -> MapDelta:
    rows = np.zeros(len(changed), MAP_POINT)
    for name, column in zip(("kx", "ky", "kz"), np.reshape(changed, (-1, 3)).T, strict=True):
        rows[name] = column
    rows["x"] = number
    gone = np.array(removed, np.int16).reshape(-1, 3)
    return MapDelta(number, number, rows, gone, number, reset, len(rows), 0.05)


@given(deltas)
def test_the_newest_point_of_every_voxel_stays(
    changes: list[tuple[list[Key], list[Key], bool, bool]],
) -> None:
    merged, expected = MergedMap(), dict[Key, int]()
    for number, (changed, removed, reset, looked_at) in enumerate(changes):
        merged.add(delta_of(number, changed, removed, reset))
        if reset:
            expected.clear()
        for key in removed:
            expected.pop(key, None)
        for key in changed:
            expected[key] = number
        if looked_at:
            merged.points()
    points = merged.points()
    found = {} if points is None else {(p["kx"], p["ky"], p["kz"]): int(p["x"]) for p in points}
    assert found == expected
    assert points is None or len(points) == len(expected)


def test_keys_of_the_whole_int16_range_stay_apart() -> None:
    corners = [(x, y, z) for x in (-32768, 32767) for y in (-32768, 0) for z in (-1, 32767)]
    merged = MergedMap()
    merged.add(delta_of(1, corners, [], False))
    merged.add(delta_of(2, [], corners[:3], False))
    points = merged.points()
    assert points is not None
    assert {(p["kx"], p["ky"], p["kz"]) for p in points} == set(corners[3:])


def test_the_arrays_may_go_away_after_adding() -> None:
    merged, delta = MergedMap(), delta_of(7, [(1, 2, 3)], [], False)
    merged.add(delta)
    delta.points["x"] = -1
    points = merged.points()
    assert points is not None
    assert points["x"].tolist() == [7]
