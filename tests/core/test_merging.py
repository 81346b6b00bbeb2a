"""The merged map: a dictionary that does not lie, one surface per surface, deltas that add up, bounded memory."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from endo3d_core import merging, voxel_hash
from endo3d_core import simulated_clouds as sim
from endo3d_core.live_view import LiveView

SMALL = sim.Sensor(width=160, height=120)
KEYS = st.tuples(*[st.integers(-9, 9)] * 3)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.booleans(), KEYS), max_size=120))
def test_the_hash_is_a_dictionary(orders: list[tuple[bool, tuple[int, int, int]]]) -> None:
    keys, rows = np.full(512, voxel_hash.EMPTY, np.int64), np.zeros(512, np.int32)
    expected: dict[int, int] = {}
    for number, (adding, place) in enumerate(orders):
        key = int(voxel_hash.pack(*place))
        assert tuple(voxel_hash.unpack(key)) == place
        if adding and key not in expected:
            voxel_hash.insert(keys, rows, key, number)
            expected[key] = number
        elif not adding and key in expected:
            voxel_hash.remove(keys, rows, key)
            del expected[key]
    for x in range(-9, 10):
        key = int(voxel_hash.pack(x, 0, 0))
        assert voxel_hash.find(keys, rows, key) == expected.get(key, -1)
    assert all(voxel_hash.find(keys, rows, key) == row for key, row in expected.items())


def merged(world: merging.MergedMap, distance_mm: float, clouds: int) -> merging.MergedMap:
    """A still camera in front of a plane."""
    caster, view, pose = sim.Caster(sim.plane(), SMALL), LiveView(), np.eye(4)
    pose[2, 3] = -distance_mm
    for sequence in range(clouds):
        view.load(caster.cast(pose, sequence))
        world.merge(view.live, np.eye(4), sequence)
    return world


def test_a_surface_on_voxel_faces_stays_one() -> None:
    world = merged(merging.MergedMap(0.075), 267 * 0.075, 100)  # the plane is a voxel face
    z_um = 1e3 * (world.points(at_least=20)["z"] - 267 * 0.075)
    assert len(z_um) > 2000
    assert z_um.std() < 1.0
    assert abs(z_um.mean()) < 0.3


def test_deltas_add_up_to_the_map() -> None:
    world = merging.MergedMap(0.075)
    caster, view = sim.Caster(sim.plane(), SMALL), LiveView()
    published: dict[tuple[int, int, int], np.void] = {}
    for sequence in range(40):
        pose = sim.HandMotion().pose(sequence / 172)
        view.load(caster.cast(pose, sequence))
        world.merge(view.live, pose, sequence)
        for point in world.take_delta().points:
            published[point["kx"], point["ky"], point["kz"]] = point
    whole = {(p["kx"], p["ky"], p["kz"]): p for p in world.points()}
    assert published.keys() == whole.keys()
    assert max(abs(published[key]["z"] - whole[key]["z"]) for key in whole) < 0.005
    assert all(2 * published[key]["count"] >= whole[key]["count"] // 2 for key in whole)


def test_a_full_map_forgets_the_oldest_and_says_what_is_gone() -> None:
    world = merging.MergedMap(0.075, capacity=12_000)
    caster, view, pose = sim.Caster(sim.plane(), SMALL), LiveView(), np.eye(4)
    gone = 0
    for sequence in range(240):
        pose[:3, 3] = 0.06 * sequence, 0.0, -20.0
        view.load(caster.cast(pose, sequence))
        world.merge(view.live, pose, sequence)
        gone += len(world.take_delta().removed)
    assert world.count <= 12_000
    assert gone > 1000
    assert world.points()["last_seen"].min() > 0
