"""Registration of a scan to the CAD model of its part: where the tip is in the part's coordinates.

The scan's world lies still in the part, but for the odometry's drift: T_part_world is estimated from the visible
map points (averaged, so nearly without noise), some clouds apart, by point-to-plane steps to the nearest facets. What
earlier views knew about a direction is carried on as information that fades, so a view that shows only a cylinder
does not lose the place along it. Before that, a coarse search lays the view on the model, a bounded part at a time.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from endo3d_core import rigid
from endo3d_core.merging import CONFIRMED, COUNT, NORMAL, POS, MergedMap
from endo3d_core.registration import Frame6

Array = NDArray[np.float64]

SAMPLES_PER_RADIUS = 100.0
"""Density of the model's samples, by the radius of what is seen: their facets' planes are what distances are to."""
POINTS = 1200
"""Map points per step."""
SEARCH_POINTS = 40
SEARCH_POSES = 100
"""Tried with one look: a few milliseconds."""
SEARCH_STEP = 0.45
"""Spacing of the tried places, in radii of what is seen; turns about the normal are as far apart, in radians."""
REFINED = 64
"""Best places of the search that are registered, one per look; the best of them is believed."""
TURNS_PER_PLACE = 2
REFINED_POINTS = 300
FIRST_GATE, LAST_GATE = 0.3, 0.03
"""How far a point may be from the model, in radii: at first, and once aligned."""
LEAST_SHARE = 0.5
"""Of the points that must lie on the model."""
SAME_SIDE = 0.5
"""Least cosine between the map's normal and the facet's."""
NEW = 0.2
"""Weight of a look beside what was known. Looks share map points, so their information is not independent: a mean
of the two is safe for any correlation (covariance intersection: Julier and Uhlmann, ACC 1997), a sum is not."""
HELD = 0.01
"""A direction known worse than this, in radii, is not moved at all, and reported."""
_LOST_AFTER = 15
"""Looks that may fail before the search begins anew."""
_ITERATIONS = 12
_MOST_SAMPLES = 2_000_000


class Fit(StrEnum):
    SEARCHING = "searching"
    ALIGNED = "aligned"
    DEGENERATE = "degenerate"
    LOST = "lost"


class Part:
    """A triangle mesh in mm, sampled: vertices (n, 3), faces (m, 3), outside where the corners turn left."""

    def __init__(self, vertices: Array, faces: NDArray[np.integer]) -> None:
        corners = np.asarray(vertices, np.float64)[np.asarray(faces)]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(normals, axis=1)
        self._corners = corners[length > 0]
        self._areas = 0.5 * length[length > 0]
        self._normals = normals[length > 0] / length[length > 0, None]
        if not len(self._areas):
            raise ValueError("the model has no facet with an area")
        self.extent_mm = float(np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0)))

    def sampled(self, spacing_mm: float) -> tuple[Array, Array]:
        """(n, 3) points about ``spacing_mm`` apart and their facets' normals; always the same ones."""
        count = np.minimum(self._areas / spacing_mm**2, _MOST_SAMPLES * self._areas / self._areas.sum())
        edges = np.linalg.norm(self._corners - np.roll(self._corners, 1, axis=1), axis=2).max(axis=1)
        count = np.maximum(np.ceil(count), np.minimum(np.ceil(edges / spacing_mm), 64)).astype(np.int64)
        facet = np.repeat(np.arange(len(count)), count)
        # Of each facet a low-discrepancy sequence (R2, Roberts 2018), folded into the triangle.
        number = np.arange(len(facet)) - np.repeat(np.cumsum(count) - count, count)
        u, v = (0.5 + number * 0.7548776662466927) % 1.0, (0.5 + number * 0.5698402909980532) % 1.0
        outside = u + v > 1.0
        u[outside], v[outside] = 1.0 - u[outside], 1.0 - v[outside]
        a, b, c = self._corners[facet].transpose(1, 0, 2)
        return a + u[:, None] * (b - a) + v[:, None] * (c - a), self._normals[facet]


def visible_points(world: MergedMap) -> tuple[Array, Array]:
    """Positions and normals, each (n, 3) in the world, of the confirmed map points the last cloud fell onto."""
    rows = world.touched
    seen = world.rows[rows[world.ints[rows, COUNT] >= CONFIRMED]].astype(np.float64)
    return seen[:, POS : POS + 3], seen[:, NORMAL : NORMAL + 3]


@dataclass(frozen=True, slots=True)
class PartEstimate:
    """How the scan lies on the part."""

    T_part_world: Array
    """(4, 4), mm."""
    state: Fit
    information: Array
    """(6, 6) of (translation mm, rotation rad) in the camera's axes; zero while searching or lost."""
    sigma_weak_mm: float
    weak_direction: Array
    """(6,) unit vector: translation, and rotation scaled by the radius of the visible surface."""
    inlier_share: float
    residual_mm: float


class PartRegistration:
    """Keeps T_part_world; ``T_part_camera`` is where the first camera was, if that is known."""

    def __init__(self, part: Part, radius_mm: float, T_part_camera: Array | None = None) -> None:
        """``radius_mm``: of what the head sees, about; it sets every length."""
        self.part, self._radius_mm, self._given = part, radius_mm, T_part_camera
        fine_mm, coarse_mm = radius_mm / SAMPLES_PER_RADIUS, 0.05 * radius_mm
        self._fine, self._fine_normals = part.sampled(fine_mm)
        self._coarse, self._coarse_normals = part.sampled(coarse_mm)
        self._fine_tree, self._coarse_tree = cKDTree(self._fine), cKDTree(self._coarse)
        self._places = _thinned(self._coarse, self._coarse_normals, SEARCH_STEP * radius_mm)
        self._bases = np.array([_basis(normal) for normal in self._places[1]])
        self.reset()

    def reset(self) -> None:
        """Nothing is known but the given pose."""
        self._T: Array | None = self._given  # of the world, once the first look has come
        self._placed = False
        self._known = np.zeros((6, 6))
        self._failures = 0
        self._begin_search()
        self.estimate = self._unknown(Fit.SEARCHING)

    def look(self, points: Array, normals: Array, T_world_camera: Array, frame: Frame6) -> PartEstimate:
        """Visible map points (n, 3) and their normals in the world -> where the world lies now."""
        some = slice(None, None, max(len(points) // POINTS, 1))
        points, normals = points[some], normals[some]
        if self._given is not None and not self._placed:
            self._T, self._placed = self._given @ rigid.inverse(T_world_camera), True
        if self._T is None:
            self._search(points, normals)
        if self._T is not None and len(points) >= 6:
            self._refine(points, normals, T_world_camera, frame)
        return self.estimate

    def _refine(self, points: Array, normals: Array, T_world_camera: Array, frame: Frame6) -> None:
        """One look: a step from the pose so far, with what was known before."""
        assert self._T is not None
        fresh = self.estimate.state in (Fit.SEARCHING, Fit.LOST)
        gates = np.geomspace(FIRST_GATE, LAST_GATE, _ITERATIONS) if fresh else np.full(2, 2.0 * LAST_GATE)
        centre = rigid.apply(T_world_camera, frame.centre)
        before, T = self._T, self._T
        new = 1.0 if fresh else NEW
        known = (1.0 - new) * self._known
        for gate in gates:
            n = self._equations(points, normals, T, centre, gate * self._radius_mm)
            if n.share < LEAST_SHARE:
                self._fail()
                return
            # What was known holds the step to where the last look left the world.
            off = _twist_between(before, T, centre, self._radius_mm)
            information = new * n.information + known
            values, vectors = np.linalg.eigh(information)
            worst_mm = max(n.residual_mm, HELD * self._radius_mm)
            step = _step(values, vectors, new * n.gradient - known @ off, worst_mm)
            T = T @ _moved(step, centre, self._radius_mm)
        self._T, self._known, self._failures = rigid.orthonormal(T), information, 0
        sigma_mm = float(1.0 / np.sqrt(max(values[0], 1e-12)))
        scale = np.diag([1.0, 1.0, 1.0, *[self._radius_mm] * 3])
        at_origin = scale @ rigid.adjoint(rigid.translation(-centre)) @ rigid.adjoint(T_world_camera)
        R = T_world_camera[:3, :3].T
        self.estimate = PartEstimate(
            self._T,
            Fit.ALIGNED if sigma_mm < HELD * self._radius_mm else Fit.DEGENERATE,
            at_origin.T @ self._known @ at_origin,
            sigma_mm,
            np.concatenate([R @ vectors[:3, 0], R @ vectors[3:, 0]]),
            n.share,
            n.residual_mm,
        )

    def _fail(self) -> None:
        """This view does not lie on the model where it should."""
        self._failures += 1
        aligned = self._known.any()
        if not aligned or self._failures > _LOST_AFTER:
            self._T, self._known, self._failures = None, np.zeros((6, 6)), 0
            self._begin_search()
        self.estimate = self._unknown(Fit.LOST if aligned else Fit.SEARCHING)

    def _unknown(self, state: Fit) -> PartEstimate:
        T = np.eye(4) if self._T is None or not (self._placed or self._known.any()) else self._T
        return PartEstimate(T, state, np.zeros((6, 6)), np.inf, np.zeros(6), 0.0, np.nan)

    def _begin_search(self) -> None:
        self._tried = 0
        self._settled: tuple[float, Array | None] = 0.0, None
        self._best: list[tuple[float, Array]] = []

    def _search(self, points: Array, normals: Array) -> None:
        """The next places: the view's middle laid on the model's surface, turned about the normal."""
        places = self._places[0]
        turns = np.arange(0.0, 2 * np.pi, SEARCH_STEP)
        total = len(places) * len(turns)
        if self._tried >= total:
            self._settle(points, normals)
            return
        few = slice(None, None, max(len(points) // SEARCH_POINTS, 1))
        middle, towards = points.mean(axis=0), normals.mean(axis=0)
        place, turn = np.divmod(np.arange(self._tried, min(self._tried + SEARCH_POSES, total)), len(turns))
        about = Rotation.from_rotvec(np.multiply.outer(turns[turn], [0.0, 0.0, 1.0])).as_matrix()
        T = np.tile(np.eye(4), (len(place), 1, 1))
        T[:, :3, :3] = self._bases[place] @ about @ _basis(towards).T
        T[:, :3, 3] = places[place] - T[:, :3, :3] @ middle
        scores = self._scores(T, points[few], normals[few])
        for k in np.unique(place):
            there = np.flatnonzero(place == k)
            for one in there[np.argsort(-scores[there])][:TURNS_PER_PLACE]:
                self._best.append((float(scores[one]), T[one]))
        self._best = sorted(self._best, key=lambda found: -found[0])[:REFINED]
        self._tried += SEARCH_POSES

    def _scores(self, T: Array, points: Array, normals: Array) -> Array:
        """(n,) how close points (m, 3) lie to the model at each of T (n, 4, 4), and how alike the normals are."""
        reach_mm = FIRST_GATE * self._radius_mm
        moved = np.einsum("nij,mj->nmi", T[:, :3, :3], points) + T[:, None, :3, 3]
        gap, near = _nearest(self._coarse_tree, moved.reshape(-1, 3), reach_mm)
        facing = np.concatenate([self._coarse_normals, np.zeros((1, 3))])[near].reshape(moved.shape)
        side = np.einsum("nij,mj,nmi->nm", T[:, :3, :3], normals, facing)
        closeness = np.clip(1.0 - gap.reshape(side.shape) / reach_mm, 0.0, 1.0)
        return np.asarray((closeness * np.clip(side, 0.0, 1.0)).sum(axis=1))

    def _settle(self, points: Array, normals: Array) -> None:
        """Registers the next of the best places; after the last, the one where most points lie closest is taken."""
        few = slice(None, None, max(len(points) // REFINED_POINTS, 1))
        centre = points.mean(axis=0)
        _, T = self._best.pop()
        for gate in np.geomspace(FIRST_GATE, LAST_GATE, _ITERATIONS):
            n = self._equations(points[few], normals[few], T, centre, gate * self._radius_mm)
            if n.share < LEAST_SHARE / 2:
                break
            values, vectors = np.linalg.eigh(n.information)
            worst_mm = max(n.residual_mm, HELD * self._radius_mm)
            T = T @ _moved(_step(values, vectors, n.gradient, worst_mm), centre, self._radius_mm)
        merit = n.share / n.residual_mm if n.share >= LEAST_SHARE else 0.0
        if merit > self._settled[0]:
            self._settled = merit, T
        if not self._best:
            self._T = self._settled[1]
            self._begin_search()

    def _equations(self, points: Array, normals: Array, T: Array, centre: Array, gate_mm: float) -> _Equations:
        """Point-to-plane rows at T_part_world, for a motion of the world about ``centre`` in its own axes."""
        fine = gate_mm < 0.1 * self._radius_mm
        tree, samples, facing = (
            (self._fine_tree, self._fine, self._fine_normals)
            if fine
            else (self._coarse_tree, self._coarse, self._coarse_normals)
        )
        on_part = rigid.apply(T, points)
        gap, near = _nearest(tree, on_part, gate_mm)
        paired = np.isfinite(gap)
        n = facing[near[paired]] @ T[:3, :3]
        paired_normals = normals[paired]
        alike = np.einsum("ij,ij->i", n, paired_normals) > SAME_SIDE
        n, p = n[alike], points[paired][alike]
        residual = np.einsum("ij,ij->i", on_part[paired][alike] - samples[near[paired]][alike], n @ T[:3, :3].T)
        spread = max(float(1.4826 * np.median(np.abs(residual))) if residual.size else np.inf, 1e-6 * self._radius_mm)
        weight = 1.0 / (1.0 + (residual / (2.0 * spread)) ** 2) ** 2
        s = (p - centre) / self._radius_mm
        J = np.concatenate([n, np.cross(s, n)], axis=1)
        information = (J * weight[:, None]).T @ J / spread**2
        gradient = -(J * weight[:, None]).T @ residual / spread**2
        return _Equations(information, gradient, len(residual) / max(len(points), 1), spread)


@dataclass(frozen=True, slots=True)
class _Equations:
    """Information (6, 6) and gradient (6,) in scaled coordinates, share of points on the model, their spread."""

    information: Array
    gradient: Array
    share: float
    residual_mm: float


def _nearest(tree: cKDTree, points: Array, reach_mm: float) -> tuple[Array, NDArray[np.int64]]:
    """Distance and number of the nearest sample, each (n,); infinity and one past the last beyond the reach."""
    gap, near = tree.query(points, distance_upper_bound=reach_mm)
    return np.asarray(gap), np.asarray(near, np.int64)


def _step(values: Array, vectors: Array, gradient: Array, worst_mm: float) -> Array:
    """The Gauss-Newton step in the directions that are known; the others are held."""
    known = values > 1.0 / worst_mm**2
    step: Array = vectors[:, known] @ (vectors[:, known].T @ gradient / values[known])
    return step


def _moved(step: Array, centre: Array, radius_mm: float) -> Array:
    """A small motion of the world about a point of it; rotations in ``step`` are scaled by the radius."""
    twist = np.concatenate([step[:3], step[3:] / radius_mm])
    return rigid.translation(centre) @ rigid.exp(twist) @ rigid.translation(-centre)


def _twist_between(before: Array, after: Array, centre: Array, radius_mm: float) -> Array:
    """The inverse of ``_moved``."""
    D = rigid.translation(-centre) @ rigid.inverse(before) @ after @ rigid.translation(centre)
    twist = rigid.log(D)
    return np.concatenate([twist[:3], radius_mm * twist[3:]])


def _basis(normal: Array) -> Array:
    """(3, 3) rotation whose third column is along ``normal``."""
    z = normal / np.linalg.norm(normal)
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _thinned(points: Array, normals: Array, spacing_mm: float) -> tuple[Array, Array]:
    """One sample per cell of a grid and side of the surface, with the mean normal around it."""
    axis = np.abs(normals).argmax(axis=1)
    side = 2 * axis + (normals[np.arange(len(normals)), axis] > 0)
    cells = np.column_stack([np.floor(points / spacing_mm).astype(np.int64), side])
    _, first, member = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    mean = np.zeros((len(first), 3))
    np.add.at(mean, member.ravel(), normals)
    return points[first], mean / np.linalg.norm(mean, axis=1, keepdims=True)
