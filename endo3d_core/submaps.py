"""Submaps that tracking left behind when it was lost, and the way back into them.

A new submap begins in a world of its own. Now and then a cloud of it is looked for in the older ones, around a pose of
their path at a time. What is found has to be confirmed by a later cloud, and no direction may be left open: then both
submaps are one again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from endo3d_core import health, rigid
from endo3d_core.live_view import LiveView
from endo3d_core.map_rows import Rows, absorb, finished
from endo3d_core.merging import GRADIENT, NORMAL, POS, MergedMap
from endo3d_core.recovery import Search, convincing
from endo3d_core.registration import Linearisation, Scales, visible_surface

Array = NDArray[np.float64]

_SPACING = 0.25
"""Poses of a path are kept so far apart, in radii of the visible surface: one look reaches twice as far."""
_LONGEST_PATH = 200
_SAME_CELLS = 3.0
"""Both clouds have to say the same of where the submaps lie, to so many pooled cells."""


@dataclass(frozen=True, slots=True, eq=False)
class Submap:
    """The confirmed rows of a map, as ``merging`` lays them out, and where it was seen from."""

    number: int
    rows: Rows
    path: list[Array]

    @property
    def ints(self) -> NDArray[np.int32]:
        return self.rows.view(np.int32)

    @property
    def used(self) -> int:
        return len(self.rows)


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """An older submap that the camera is back in."""

    submap: Submap
    T_older_newer: Array
    """(4, 4): from the world of the newer submap to that of the older one."""


class Submaps:
    """The submaps before the present one; together they hold at most ``capacity`` points, the oldest go first."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self.clear()

    def __len__(self) -> int:
        return len(self._older)

    def clear(self) -> None:
        self._older: list[Submap] = []
        self._path: list[Array] = []
        self._next = 0
        self._candidate: Found | None = None

    def follow(self, T_world_camera: Array, view: LiveView) -> None:
        """Remembers where the present submap was seen from."""
        apart_mm = _SPACING * visible_surface(view.live).radius_mm
        near = any(np.linalg.norm(T[:3, 3] - T_world_camera[:3, 3]) < apart_mm for T in self._path)
        if not near and len(self._path) < _LONGEST_PATH:
            self._path.append(T_world_camera)

    def leave(self, number: int, world: MergedMap) -> None:
        """The present submap becomes an older one."""
        if self._path and world.count:
            self._older.append(Submap(number, finished(world), self._path))
        self._path, self._candidate = [], None
        while sum(old.used for old in self._older) > self._capacity:
            self._older.pop(0)

    def look(self, T_world_camera: Array, view: LiveView, equations: Linearisation) -> Found | None:
        """Looks for one cloud in one place; what the cloud before found there and this one confirms."""
        if self._candidate is not None:
            before, self._candidate = self._candidate, None
            expected = before.T_older_newer @ T_world_camera
            again = self._at(before.submap, expected, T_world_camera, view, equations, starts=[expected])
            off_mm = np.inf if again is None else _apart_mm(again, before, T_world_camera, view)
            return before if off_mm < _SAME_CELLS * view.pitch_mm else None
        places = [(old, T) for old in self._older for T in old.path]
        old, T = places[self._next % len(places)]
        self._next += 1
        self._candidate = self._at(old, T, T_world_camera, view, equations, starts=[])
        return None

    def rejoin(self, found: Found, world: MergedMap) -> None:
        """Both submaps in ``world``, in the axes of the older one."""
        newer = moved(finished(world), found.T_older_newer)
        world.clear()
        absorb(world, found.submap.rows)
        absorb(world, newer)
        self._older.remove(found.submap)
        self._path = [*found.submap.path, *(found.T_older_newer @ T for T in self._path)]

    def _at(
        self,
        old: Submap,
        T: Array,
        T_world_camera: Array,
        view: LiveView,
        equations: Linearisation,
        starts: list[Array],
    ) -> Found | None:
        """The cloud in an older submap, around a pose T there."""
        search = Search(old, T, view)
        T_older_camera = search.look(view, starts, equations)
        if T_older_camera is None:
            return None
        scales = Scales(view.pitch_mm, view.pitch_mm / 4.0, 0.1, view.normal_rad)
        frame = visible_surface(view.live)
        n = equations.at(T_older_camera, old, search.rows, view.live, view.coefficients, frame, scales)
        if health.solve(n, view.sigma_mm).held.size or not convincing(n, view.texture_noise):
            return None
        return Found(old, T_older_camera @ rigid.inverse(T_world_camera))


def _apart_mm(a: Found, b: Found, T_world_camera: Array, view: LiveView) -> float:
    """How far apart two opinions put what is seen."""
    centre = rigid.apply(T_world_camera, visible_surface(view.live).centre)
    return float(np.linalg.norm(rigid.apply(a.T_older_newer, centre) - rigid.apply(b.T_older_newer, centre)))


def moved(rows: Rows, T: Array) -> Rows:
    """A copy of map rows in other axes."""
    out, R = rows.copy(), T[:3, :3].T.astype(np.float32)
    out[:, POS : POS + 3] = rigid.apply(T, rows[:, POS : POS + 3])
    for first in (NORMAL, GRADIENT):
        out[:, first : first + 3] = rows[:, first : first + 3] @ R
    return out
