"""The trackers to choose from, behind one interface: projective (default), kiss-icp, small_gicp.

The latter two are made for lidar and serve as baselines: they see points only, no intensity, no grid. What they
track is merged into the same kind of map.
"""

from __future__ import annotations

from typing import Any, Literal, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from endo3d_core import rigid
from endo3d_core.live_view import LiveView
from endo3d_core.loop_closure import LoopClosing
from endo3d_core.merging import MergedMap
from endo3d_core.odometry import Estimate, Odometry, State

Array = NDArray[np.float64]
Backend = Literal["projective", "kiss-icp", "small-gicp"]
BACKENDS: tuple[Backend, ...] = get_args(Backend)


class Tracker(Protocol):
    """Clouds to poses and a merged map."""

    map: MergedMap

    @property
    def view(self) -> LiveView:
        """The last cloud, made ready."""

    def track(self, channels: NDArray[np.float32], sequence: int, stamp_ns: int) -> Estimate:
        """One cloud (height, width, 6) float32: x y z mm, intensity, quality, sigma mm."""

    def reset(self) -> None:
        """Empty map; the next cloud's camera is the world."""


def make(
    backend: Backend = "projective",
    merging_distance_mm: float = 0.075,
    capacity: int = 1_000_000,
    *,
    loop_closure: bool = False,
) -> Tracker:
    """A tracker by name. Raises ValueError for an unknown one, and for loops that another than ours should close."""
    if loop_closure and backend != "projective":
        raise ValueError(f"the backend {backend!r} can't close loops; use 'projective'")
    match backend:
        case "projective":
            return (LoopClosing if loop_closure else Odometry)(merging_distance_mm, capacity)
        case "kiss-icp":
            return PointTracker(KissIcp(), merging_distance_mm, capacity)
        case "small-gicp":
            return PointTracker(SmallGicp(), merging_distance_mm, capacity)
    raise ValueError(f"no backend {backend!r}; there are: {', '.join(BACKENDS)}")


class Registration(Protocol):
    """Registers bare points to what it saw before."""

    def register(self, points: Array) -> tuple[Array, Array]:
        """(n, 3) float64 mm -> T_world_camera (4, 4) and information (6, 6), zero if it tells none."""

    def reset(self) -> None: ...


class PointTracker:
    """A registration of bare points, and the map of what it tracks."""

    def __init__(self, registration: Registration, merging_distance_mm: float, capacity: int) -> None:
        self.registration = registration
        self.map = MergedMap(merging_distance_mm, capacity)
        self.view = LiveView()

    def reset(self) -> None:
        self.map.clear()
        self.registration.reset()

    def track(self, channels: NDArray[np.float32], sequence: int, stamp_ns: int) -> Estimate:
        try:
            count = self.view.load(channels)
        except ValueError:
            count = 0
        if count < 100:
            return Estimate(np.eye(4), np.zeros((6, 6)), State.LOST, np.inf, np.zeros(6), 0.0, np.nan, 0.0, 0)
        T, information = self.registration.register(self.view.points())
        self.map.merge(self.view.live, T, sequence)
        values, vectors = np.linalg.eigh(information)
        sigma_mm = float(self.view.sigma_mm / np.sqrt(values[0])) if values[0] > 0 else np.inf
        return Estimate(T, information, State.TRACKING, sigma_mm, vectors[:, 0], 1.0, np.nan, 0.0, 0)


class KissIcp:
    """kiss-icp: Vizzo et al., IEEE RA-L 8:1029 (2023), with its lengths scaled from metres to the endoscope's mm.

    These are the best of fifteen configurations that were tried. It reports no uncertainty.
    """

    def __init__(
        self, voxel_mm: float = 0.3, points_per_voxel: int = 20, threshold_mm: float = 0.1, convergence: float = 1e-4
    ) -> None:
        self._lengths = voxel_mm, points_per_voxel, threshold_mm, convergence
        self.reset()

    def reset(self) -> None:
        from kiss_icp.config import KISSConfig
        from kiss_icp.kiss_icp import KissICP

        voxel_mm, points_per_voxel, threshold_mm, convergence = self._lengths
        config: Any = KISSConfig()
        config.data.max_range, config.data.min_range, config.data.deskew = 60.0, 0.0, False
        config.mapping.voxel_size, config.mapping.max_points_per_voxel = voxel_mm, points_per_voxel
        config.registration.max_num_threads, config.registration.convergence_criterion = 1, convergence
        config.adaptive_threshold.initial_threshold, config.adaptive_threshold.min_motion_th = threshold_mm, 0.002
        self._odometry: Any = KissICP(config)

    def register(self, points: Array) -> tuple[Array, Array]:
        self._odometry.register_frame(points, np.zeros(0))
        return rigid.orthonormal(self._odometry.last_pose), np.zeros((6, 6))


class SmallGicp:
    """small_gicp's VGICP against an incremental map of Gaussian voxels: Koide, JOSS 9:6948 (2024)."""

    def __init__(self, voxel_mm: float = 0.3, neighbours: int = 10) -> None:
        self._voxel_mm, self._neighbours = voxel_mm, neighbours
        self.reset()

    def reset(self) -> None:
        import small_gicp

        self._voxels: Any = small_gicp.GaussianVoxelMap(self._voxel_mm)
        self._T, self._step = np.eye(4), np.eye(4)

    def register(self, points: Array) -> tuple[Array, Array]:
        import small_gicp

        cloud, _ = small_gicp.preprocess_points(
            points, downsampling_resolution=self._voxel_mm / 3, num_neighbors=self._neighbours, num_threads=1
        )
        information = np.zeros((6, 6))
        if self._voxels.size() > 0:
            result = small_gicp.align(
                self._voxels, cloud, init_T_target_source=self._T @ self._step, num_threads=1,
                max_correspondence_distance=2.0 * self._voxel_mm, rotation_epsilon=1e-6, translation_epsilon=1e-5,
            )  # fmt: skip
            self._step = rigid.inverse(self._T) @ result.T_target_source
            self._T = rigid.orthonormal(result.T_target_source)
            # small_gicp orders rotation before translation.
            order = [3, 4, 5, 0, 1, 2]
            information = result.H[np.ix_(order, order)]
        self._voxels.insert(cloud, self._T)
        return self._T, information
