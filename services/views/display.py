"""Messages to Rerun entries, thinned to what an eye can follow. No clock: stamps decide."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d.schemas import messages as m
from endo3d.services.views import entries
from endo3d.services.views.blueprint import BEFORE_ANY_MAP, Stand
from endo3d.services.views.colouring import colouring
from endo3d.services.views.entries import Entry
from endo3d.services.views.merged import MergedMap, starts_afresh
from endo3d.services.views.principal import principal, without_strays
from endo3d.services.views.scan import xyz
from endo3d.services.views.splat import looking, oblique

MOST_SHOWN = 400_000
"""Points of the merged map on the screen; of a larger map every k-th."""

MOST_OF_WAY = 20_000
"""Positions of the way on the screen; when there are more, every other is left out."""
RERUN_FIELD_DEG = 68.0
"""Across Rerun's 3-D view of about 4 : 3."""


class Display:
    """What is on show: images and poses at ``rate_hz``, clouds and depth maps at ``cloud_hz``, map and way at
    ``map_hz``."""

    def __init__(
        self,
        rate_hz: float = 30.0,
        cloud_hz: float = 10.0,
        map_hz: float = 2.0,
        colour: str = "height",
        deviation_um: Callable[[NDArray[Any]], NDArray[np.floating]] | None = None,
    ) -> None:
        """deviation_um: map points -> distances from the truth (n,), for colour ``deviation``."""
        self.colour = colour
        self.deviation_um = deviation_um
        self.viewer = np.zeros(3)
        self.way: list[tuple[float, float, float]] = []
        self.merged = MergedMap()
        hz = {"cloud": cloud_hz, "depth": cloud_hz, "map": map_hz, "way": map_hz}
        self._period_ns = {kind: 1e9 / min(rate, rate_hz) for kind, rate in hz.items()}
        self._most_ns = 1e9 / rate_hz
        self._shown_ns: dict[str, int] = {}
        self._camera: m.CameraCalibration | None = None
        self._image_width = 0

    def show(self, message: m.Message) -> Iterator[Entry]:
        """What changes with this message; nothing if it comes too soon after the last of its kind."""
        match message:
            case m.Frame() if self._due("frame", message.stamp_ns):
                entry = next(entries.frame(message))
                yield from self._frustum(entry)
                yield entry
            case m.Cloud() if self._due("cloud", message.stamp_ns):
                yield from entries.cloud(message, self.colour)
            case m.DepthMap() if self._due("depth", message.stamp_ns):
                yield from entries.depth(message)
            case m.Pose() if message.state is not m.Tracking.LOST:
                yield from self._pose(message)
            case m.MapDelta():
                self.merged.add(message)
                if starts_afresh(message):
                    self.way.clear()
                    yield from entries.nothing(entries.MAP, entries.WAY)
                if self._due("map", message.stamp_ns):
                    yield from self.map_now()
            case m.CameraCalibration():
                self._camera, self._image_width = message, 0
            case m.ProjectorCalibration():
                yield from entries.projector(message)
            case m.Status():
                yield from entries.status(message)
            case m.Mode():
                yield from entries.mode(message)
            case m.LogLine():
                yield from entries.log_line(message)
            case _:
                pass

    def map_now(self) -> Iterator[Entry]:
        """The merged map as it is, coloured."""
        points = self.merged.points()
        if points is None or not len(points):
            return
        points = points[:: -(-len(points) // MOST_SHOWN)]
        deviation_um = self.deviation_um(points) if self.deviation_um is not None else None
        rgb = colouring(points, self.colour, self.viewer, deviation_um).rgb()
        radius_mm = 0.6 * self.merged.merging_distance_mm or entries.CLOUD_RADIUS_MM
        yield entries.points_entry(entries.MAP, xyz(points), rgb, radius_mm)

    def stand(self) -> Stand:
        """From where map and way are seen whole."""
        points = self.merged.points()
        if points is None or len(points) < 3:
            return BEFORE_ANY_MAP
        positions = without_strays(xyz(points[:: -(-len(points) // 50_000)]))
        axes, centre = principal(positions, self.viewer)
        seen = np.concatenate([positions, np.reshape(self.way, (-1, 3))])
        eye = looking(seen, oblique(axes), axes[2], (1600, 1200), field_deg=RERUN_FIELD_DEG)
        ahead = (centre - eye.position) @ eye.R[2]
        return Stand(eye.position, eye.position + ahead * eye.R[2], axes[2])

    def _pose(self, pose: m.Pose) -> Iterator[Entry]:
        if not self._due("pose", pose.stamp_ns):
            return
        x, y, z = self.viewer = pose.T_world_camera[:3, 3].copy()
        self.way.append((float(x), float(y), float(z)))
        if len(self.way) > MOST_OF_WAY:
            self.way = self.way[::2]
        yield from entries.pose(pose)
        if self._due("way", pose.stamp_ns):
            yield from entries.way(np.array(self.way, np.float32))

    def _frustum(self, image: Entry) -> Iterator[Entry]:
        """The pinhole, when the calibration or the shown image's size is new."""
        if self._camera is not None and image.width != self._image_width:
            self._image_width = image.width
            yield from entries.camera(self._camera, image.width)

    def _due(self, kind: str, stamp_ns: int) -> bool:
        """Whether a period has passed since the last of this kind, or time went back (a loop, a seek)."""
        last = self._shown_ns.get(kind)
        due = last is None or stamp_ns < last or stamp_ns - last >= 0.98 * self._period_ns.get(kind, self._most_ns)
        if due:
            self._shown_ns[kind] = stamp_ns
        return due
