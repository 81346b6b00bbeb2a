"""A rig without optics: frames, clouds, poses and map deltas of a real scan's sizes, at a steady pace."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from endo3d.schemas import topics
from endo3d.schemas.messages import POINT, Cloud, Frame, MapDelta, Message, Mode, Pose, Tracking
from endo3d.services.runtime.service import Config, Source
from endo3d_core.merging import MAP_POINT

PATTERNS = "interleaved f1=15"


class SteadyConfig(Config):
    rate_hz: float = Field(30.0, gt=0)
    cloud_hz: float = Field(30.0, gt=0)
    map_hz: float = Field(30.0, gt=0)
    map_points: int = 3_000
    """Of a delta: of the 7000 voxels in view, those that are new, moved, or doubled their count."""


class Steady(Source[SteadyConfig]):
    """Publishes by a schedule, and catches up when it was held up: what is missing at the end was held up for good."""

    Config = SteadyConfig
    writes = (topics.FRAME, topics.CLOUD, topics.POSE, topics.MAP, topics.MODE)

    def __init__(self, config: SteadyConfig) -> None:
        super().__init__(config)
        self._began_s = 0.0
        self._count = 0
        self._revision = 0
        self._image = _image()
        self._points = np.zeros((300, 480), POINT)
        self._points["z"] = 20.0
        self._map = np.zeros(config.map_points, MAP_POINT)
        for axis, step in (("kx", 1), ("ky", 200)):
            self._map[axis] = np.arange(config.map_points) // step % 200

    def poll(self, timeout_s: float) -> Iterator[Message]:
        now_s = time.monotonic()
        self._began_s = self._began_s or now_s
        due_s = self._began_s + self._count / self.config.rate_hz
        if due_s > now_s:
            time.sleep(min(timeout_s, due_s - now_s))
            return
        if self._count == 0:
            yield Mode(time.time_ns(), "interleaved", PATTERNS, 1, time.time_ns(), 33_000_000, 4000.0, True)
        yield from self._messages(self._count, time.time_ns())
        self._count += 1

    def _messages(self, k: int, now_ns: int) -> Iterator[Message]:
        image = self.loan(topics.FRAME, self._image.shape, np.uint8)
        np.copyto(image, np.roll(self._image, k % 64, axis=1))
        yield Frame(now_ns, k, image, PATTERNS, k % 4, 1, 4000.0, now_ns, k)
        if self._is_due(k, self.config.cloud_hz):
            yield Cloud(now_ns, k, self._points, 7, now_ns, 1, PATTERNS, 2.0, self._points.size)
        yield Pose(now_ns, k, np.eye(4), np.eye(6), Tracking.TRACKING, 4.0, np.eye(6)[0], 0.9, 6.0, 0.3, 0, now_ns)
        if self._is_due(k, self.config.map_hz):
            self._map["kz"] = k // 20 % 30_000  # the hand has moved on
            yield self._delta(now_ns, k)

    def _delta(self, now_ns: int, k: int) -> MapDelta:
        self._revision += 1
        removed = np.empty((0, 3), np.int16)
        first = self._revision == 1
        return MapDelta(now_ns, k, self._map, removed, self._revision, first, len(self._map), 0.075)

    def _is_due(self, k: int, hz: float) -> bool:
        every = max(1, round(self.config.rate_hz / hz))
        return k % every == 0


def _image() -> NDArray[Any]:
    """(600, 960) uint8: fringes and sensor noise, so that it compresses as a frame does."""
    fringes = 110 + 80 * np.cos(2 * np.pi * 15 * np.arange(960) / 960)
    noisy = fringes + np.random.default_rng(7).normal(0, 4, (600, 960))
    return np.clip(noisy, 0, 255).astype(np.uint8)
