"""Odometry that knows when it is back: loops close, the path and the map move to where they belong.

The tracker registers to what was seen lately. What was not seen for a few keyframes leaves its map and is kept with the
keyframe it belongs to, so a place that comes back is not mixed with its old image before it is recognised.
Then the pose graph moves the keyframes, and the published map is built anew from their parts. All of it happens in
pieces, one per cloud: no cloud waits, and there is no thread.

``odom`` is the tracker's own world, which drifts and never jumps; ``world`` is the corrected one. They start as one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from endo3d_core import rigid, trajectory
from endo3d_core.keyframes import Keyframes
from endo3d_core.live_view import LiveView
from endo3d_core.loop_check import Found, LoopCheck
from endo3d_core.map_rows import Retirement, absorb, finished
from endo3d_core.merging import MergedMap
from endo3d_core.odometry import Estimate, Odometry, State
from endo3d_core.pose_graph import Edge
from endo3d_core.registration import Frame6, visible_surface

Array = NDArray[np.float64]

SPACING = 0.5
"""A keyframe each time what is seen has moved by this many of its radii, ..."""
TURN_RAD = 0.2
"""... or the view has turned by this."""
RECENT = 4
"""Keyframes for which what was not seen again stays in the tracker's map."""
OVERLAP = 1.0
"""What is seen may lie this many radii off what an old keyframe saw, besides the drift since."""
ALIKE = np.cos(np.radians(45.0))
"""Least cosine between the two views."""
DRIFT = 0.01
"""What odometry may be off by, per length of its way, from errors that are no noise. Only its ratio to a loop's
uncertainty matters, and that is smaller by far."""
_SLICE = 4096
"""Map points moved with one cloud: half a millisecond."""


TRACKED = np.dtype(
    [
        ("sequence", "<i8"),
        ("stamp_ns", "<i8"),
        ("T", "<f8", (4, 4)),
        ("information", "<f4", (6, 6)),
        ("sigma_weak_mm", "<f4"),
        ("state", "<U11"),
    ]
)
"""A pose as it was tracked (T_odom_camera), or as it is known now (T_world_camera)."""


@dataclass(frozen=True, slots=True)
class Correction:
    """What closing loops made of the path so far."""

    number: int
    """Counts corrections; poses say after which they were made."""
    T_world_odom: Array
    """(4, 4): of the clouds that come."""
    sequences: NDArray[np.int64]
    """(n,) of the keyframes."""
    stamps_ns: NDArray[np.int64]
    T_world_camera: Array
    """(n, 4, 4)."""
    T_odom_camera: Array
    """(n, 4, 4), as tracked."""


class _Tracker(Odometry):
    """Odometry that hands on its map before it begins a new one."""

    def __init__(self, merging_distance_mm: float, capacity: int, dropped: Callable[[], None]) -> None:
        self._dropped = dropped
        super().__init__(merging_distance_mm, capacity)

    def _forget(self) -> None:
        self._dropped()  # to the keyframes: the way back into it is a loop
        self.map.clear()


class LoopClosing:
    """A tracker (``backends.Tracker``) with a memory of where it was."""

    def __init__(self, merging_distance_mm: float = 0.075, capacity: int = 1_000_000) -> None:
        self._tracker = _Tracker(merging_distance_mm, capacity, self._keep_all)
        self._maps = MergedMap(merging_distance_mm, capacity), MergedMap(merging_distance_mm, capacity)
        self.reset()

    @property
    def view(self) -> LiveView:
        return self._tracker.view

    def reset(self) -> None:
        """Empty map; the next cloud's camera is the world."""
        self._tracker.reset()
        self.map, self._spare = self._maps
        self.map.clear()
        self._retirement = Retirement(self._tracker.map)
        self.keyframes = Keyframes(2 * self.map.capacity)
        self.T_world_odom = np.eye(4)
        self.correction: Correction | None = None
        """The newest; another object after every correction."""
        self._tracked, self._count = np.empty(1024, TRACKED), 0
        self._covariance = np.zeros((6, 6))
        self._submap = 0
        self._check: LoopCheck | None = None
        self._job: Iterator[None] | None = None
        self._closed = False
        self._corrected_at = -RECENT
        self._placed: Array = np.empty((0, 4, 4))

    @property
    def loops(self) -> int:
        """Loops that were found."""
        return len(self.keyframes.graph.loops)

    def track(self, channels: NDArray[np.float32], sequence: int, stamp_ns: int) -> Estimate:
        """One cloud (height, width, 6) float32: x y z mm, intensity, quality, sigma mm."""
        told = self._tracker.track(channels, sequence, stamp_ns)
        T_world_camera = self.T_world_odom @ told.T_world_camera
        estimate = replace(told, T_world_camera=T_world_camera)
        self._note(told, sequence, stamp_ns)
        if told.state is not State.LOST:
            if told.state is not State.RELOCALISED:
                self.map.merge(self.view.live, T_world_camera, sequence)
            self._covariance += trajectory.covariance(told.information)
            frame = visible_surface(self.view.live)
            self._remember(told, sequence, stamp_ns, frame)
            self._look_back(told, sequence, stamp_ns, frame)
        self._retire()
        self._go_on()
        return estimate

    def tracked(self) -> NDArray[np.void]:
        """(n,) ``TRACKED``: every pose of the path as it was tracked; 300 bytes each."""
        return self._tracked[: self._count]

    def trajectory(self) -> NDArray[np.void]:
        """(n,) ``TRACKED``: every pose of the path by all that is known now."""
        path = self.tracked().copy()
        if len(self.keyframes):
            path["T"] = self.keyframes.corrected(path["sequence"], path["T"])
        return path

    def _note(self, told: Estimate, sequence: int, stamp_ns: int) -> None:
        if self._count == len(self._tracked):
            self._tracked = np.concatenate([self._tracked, np.empty_like(self._tracked)])
        self._tracked[self._count] = (
            sequence, stamp_ns, told.T_world_camera, told.information, told.sigma_weak_mm, told.state.value,
        )  # fmt: skip
        self._count += 1

    def _remember(self, told: Estimate, sequence: int, stamp_ns: int, frame: Frame6) -> None:
        """A keyframe, when enough is new."""
        kept, T = self.keyframes, told.T_world_camera
        centre = rigid.apply(T, frame.centre)
        if len(kept) and told.submap == self._submap:
            before = kept.T_odom_camera[-1]
            moved = np.linalg.norm(centre - kept.centres[-1])
            turned = np.linalg.norm(rigid.rotation_log(before[:3, :3].T @ T[:3, :3]))
            if moved < SPACING * frame.radius_mm and turned < TURN_RAD:
                return
        self._add(told, sequence, stamp_ns, frame)

    def _add(self, told: Estimate, sequence: int, stamp_ns: int, frame: Frame6) -> int:
        kept, T = self.keyframes, told.T_world_camera
        centre = rigid.apply(T, frame.centre)
        joined = told.submap == self._submap
        moved_mm = float(np.linalg.norm(centre - kept.centres[-1])) if len(kept) else 0.0
        if not joined:  # anywhere near
            moved_mm = frame.radius_mm / DRIFT
        covariance = self._covariance + self._systematic(DRIFT * moved_mm, frame)
        self._covariance, self._submap = np.zeros((6, 6)), told.submap
        return kept.add(sequence, stamp_ns, T, centre, _inverted(covariance), joined)

    def _systematic(self, length_mm: float, frame: Frame6) -> Array:
        """(6, 6) covariance of what is no noise: never less than the spread of single points."""
        variance = length_mm**2 + self.view.sigma_mm**2
        return np.diag([variance] * 3 + [variance / frame.radius_mm**2] * 3)

    def _look_back(self, told: Estimate, sequence: int, stamp_ns: int, frame: Frame6) -> None:
        """Goes on with a loop that may be one, or thinks of the next."""
        newest = len(self.keyframes) - 1
        if self._check is None:
            if self.keyframes.sequences[newest] == sequence and self._job is None:
                self._check = self._candidate(frame)
            return
        found = self._check.look(self.view, self.T_world_odom @ told.T_world_camera)
        if found is not None:
            if self.keyframes.sequences[newest] != sequence:
                newest = self._add(told, sequence, stamp_ns, frame)
            self._close(self._check.candidate, newest, found, frame)
        if self._check.over:
            self._check = None

    def _candidate(self, frame: Frame6) -> LoopCheck | None:
        """The nearest old keyframe that saw what is seen now."""
        kept = self.keyframes
        old = len(kept) - 1 - RECENT
        if old < 1:
            return None
        C, poses = kept.corrections(), kept.graph.poses
        centres = np.einsum("kij,kj->ki", C[:, :3, :3], np.array(kept.centres)) + C[:, :3, 3]
        away = np.linalg.norm(centres[:old] - centres[-1], axis=1)
        steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
        way = steps.sum() - np.concatenate([[0.0], np.cumsum(steps)])[:old]
        alike = poses[:old, :3, 2] @ poses[-1, :3, 2] > ALIKE
        near = np.flatnonzero(alike & (away < OVERLAP * frame.radius_mm + DRIFT * way))
        if not near.size:
            return None
        candidate = int(near[np.argmin(away[near])])
        around = np.concatenate([kept.part(k) for k in range(max(candidate - 1, 0), candidate + 2)])
        check = LoopCheck(candidate, kept.warped(around), self.view)
        return None if check.over else check

    def _close(self, candidate: int, newest: int, found: Found, frame: Frame6) -> None:
        """A loop: what the old part of the map says about where the camera is."""
        graph = self.keyframes.graph
        covariance = trajectory.covariance(found.information) + self._systematic(0.0, frame)
        T_old_new = rigid.inverse(graph.poses[candidate]) @ found.T_world_camera
        graph.close(Edge(candidate, newest, T_old_new, _inverted(covariance)))
        self._closed = True

    def _retire(self) -> None:
        """What was not seen for some keyframes leaves the tracker's map."""
        kept = self.keyframes
        if len(kept) > RECENT:
            kept.keep(self._retirement.take(kept.sequences[-1 - RECENT]))

    def _keep_all(self) -> None:
        if len(self.keyframes):
            self.keyframes.keep(finished(self._tracker.map))

    def _go_on(self) -> None:
        """The next piece of a correction; a new correction when loops were found."""
        due = self._closed and len(self.keyframes) - self._corrected_at >= RECENT
        if self._job is None and due:
            self._closed, self._job = False, self._correct()
        if self._job is not None and next(self._job, self) is self:
            self._job = None

    def _correct(self) -> Iterator[None]:
        """The keyframes to where the loops want them; then, if that is more than noise, the map."""
        graph = self.keyframes.graph
        yield from graph.optimise()
        placed = np.concatenate([self._placed, self._placed_like(graph.poses[len(self._placed) :])])
        off_mm = np.linalg.norm(self._seen(graph.poses) - self._seen(placed), axis=1).max()
        if off_mm < self.view.sigma_mm:
            return
        self._check, self._corrected_at = None, len(self.keyframes)  # it compares with where things were
        yield from self._rebuild()

    def _placed_like(self, poses: Array) -> Array:
        """Where newer keyframes are published: as tracked, by the correction in force."""
        first = len(self.keyframes) - len(poses)
        tracked = np.array(self.keyframes.T_odom_camera[first:]).reshape(-1, 4, 4)
        placed: Array = self.T_world_odom @ tracked
        return placed

    def _seen(self, poses: Array) -> Array:
        """(n, 3) middles of what the keyframes saw, if they were at ``poses``."""
        T_odom = np.array(self.keyframes.T_odom_camera)
        local = np.einsum("kji,kj->ki", T_odom[:, :3, :3], np.array(self.keyframes.centres) - T_odom[:, :3, 3])
        return np.asarray(np.einsum("kij,kj->ki", poses[:, :3, :3], local) + poses[:, :3, 3])

    def _rebuild(self) -> Iterator[None]:
        """The map anew, a part per cloud: first what was seen lately, then what the keyframes keep."""
        kept, fresh = self.keyframes, self._spare
        fresh.clear()
        yield
        old = [kept.part(k) for k in range(len(kept))]
        lately = kept.warped(finished(self._tracker.map))
        absorb(fresh, lately[:_SLICE])
        self.map, self._spare = fresh, self.map
        self.T_world_odom = kept.corrections()[-1]
        self._placed = kept.graph.poses.copy()
        self.correction = Correction(
            1 if self.correction is None else self.correction.number + 1,
            self.T_world_odom,
            np.array(kept.sequences),
            np.array(kept.stamps_ns),
            self._placed,
            np.array(kept.T_odom_camera),
        )
        for at in range(_SLICE, len(lately), _SLICE):
            yield
            absorb(self.map, lately[at : at + _SLICE])
        for part in old:
            for at in range(0, len(part), _SLICE):
                yield
                absorb(self.map, kept.warped(part[at : at + _SLICE]))


def _inverted(covariance: Array) -> Array:
    return np.asarray(np.linalg.inv(covariance), np.float64)
