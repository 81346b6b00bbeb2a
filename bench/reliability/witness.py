"""Somebody who listens to a simulated scan and knows the truth: what arrives, who is there, and what is wrong."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from endo3d.schemas import topics
from endo3d.schemas.messages import Cloud, Message, Pose, Status, Tracking, Truth
from endo3d.services.runtime.bus import Bus
from endo3d_core import rigid

WRONG_MM = 0.15
"""Two merging distances: a pose further off, that does not call itself lost, spoils the map."""
TRUTHS_KEPT = 4096
LATENCIES_KEPT = 200_000


@dataclass
class Record:
    """What was seen since the last ``Witness.take``."""

    clouds: int = 0
    poses: int = 0
    wrong: int = 0
    """Poses that say they are tracked and are further than ``WRONG_MM`` from the truth."""
    worst_mm: float = 0.0
    wrong_states: Counter[str] = field(default_factory=Counter)
    """What they call themselves."""
    cloud_latency_ms: list[float] = field(default_factory=list)
    pose_latency_ms: list[float] = field(default_factory=list)
    tracking: Counter[str] = field(default_factory=Counter)
    notes: dict[str, str] = field(default_factory=dict)
    """Service -> the first trouble its status named."""
    gone: list[str] = field(default_factory=list)
    """Services that disappeared from the bus, in order."""


class Witness:
    """Listens until the bus closes; every method may be called at any time."""

    def __init__(self, bus: Bus) -> None:
        self._lock = threading.Lock()
        self._record = Record()
        self._truths: dict[int, NDArray[np.float64]] = {}
        self._order: deque[int] = deque()
        self._scene_worlds: dict[int, NDArray[np.float64]] = {}
        """Submap -> T_scene_world, laid by the submap's first pose."""
        self.newest_cloud_ns = 0
        self.newest_pose_ns = 0
        """Of poses that are not lost."""
        self.statuses: dict[str, Status] = {}
        self.alive: set[str] = set()
        for topic, handler in (
            (topics.TRUTH, self._truth), (topics.CLOUD, self._cloud), (topics.POSE, self._pose),
            (topics.STATUS, self._status),
        ):  # fmt: skip
            bus.subscribe(topic, handler)
        bus.watch_alive(self._watch)

    def take(self) -> Record:
        """What was seen since the last call."""
        with self._lock:
            taken, self._record = self._record, Record()
        return taken

    def forget_worlds(self) -> None:
        """The odometry begins a new world: its poses are laid onto the scene anew."""
        with self._lock:
            self._scene_worlds.clear()

    def lost(self) -> Counter[str]:
        """``service: cause`` -> messages lost since the service's start."""
        return Counter(
            {
                f"{name}: {cause}": count
                for name, status in list(self.statuses.items())
                for cause, count in status.dropped.items()
                if count
            }
        )

    def all_well_after(self, stamp_ns: int, services: tuple[str, ...]) -> bool:
        """Every service is there and has said so since, and clouds and tracked poses of later frames have come."""
        with self._lock:
            return (
                min(self.newest_cloud_ns, self.newest_pose_ns) > stamp_ns
                and self.alive >= set(services)
                and all(name in self.statuses and self.statuses[name].stamp_ns > stamp_ns for name in services)
            )

    def _truth(self, message: Message) -> None:
        assert isinstance(message, Truth)
        with self._lock:
            self._truths[message.stamp_ns] = message.T_scene_camera
            self._order.append(message.stamp_ns)
            if len(self._order) > TRUTHS_KEPT:
                self._truths.pop(self._order.popleft(), None)

    def _cloud(self, message: Message) -> None:
        assert isinstance(message, Cloud)
        latency_ms = 1e-6 * (time.time_ns() - message.newest_stamp_ns)
        with self._lock:
            self.newest_cloud_ns = message.stamp_ns
            self._record.clouds += 1
            if len(self._record.cloud_latency_ms) < LATENCIES_KEPT:
                self._record.cloud_latency_ms.append(latency_ms)

    def _pose(self, message: Message) -> None:
        assert isinstance(message, Pose)
        latency_ms = 1e-6 * (time.time_ns() - (message.newest_stamp_ns or message.stamp_ns))
        with self._lock:
            record = self._record
            record.poses += 1
            record.tracking[str(message.state)] += 1
            if len(record.pose_latency_ms) < LATENCIES_KEPT:
                record.pose_latency_ms.append(latency_ms)
            if message.state is Tracking.LOST:
                return
            self.newest_pose_ns = message.stamp_ns
            error_mm = self._error_mm(message)
            record.worst_mm = max(record.worst_mm, error_mm)
            if error_mm > WRONG_MM:
                record.wrong += 1
                record.wrong_states[f"{message.state}, submap {message.submap}"] += 1

    def _error_mm(self, pose: Pose) -> float:
        """Distance of the tip from where it truly is; 0 for the first pose of a submap, and without truth."""
        T_true = self._truths.get(pose.stamp_ns)
        if T_true is None:
            return 0.0
        T_scene_world = self._scene_worlds.setdefault(pose.submap, T_true @ rigid.inverse(pose.T_world_camera))
        return float(np.linalg.norm((T_scene_world @ pose.T_world_camera - T_true)[:3, 3]))

    def _status(self, message: Message) -> None:
        assert isinstance(message, Status)
        with self._lock:
            self.statuses[message.service] = message
            if message.note:
                self._record.notes.setdefault(message.service, message.note)

    def _watch(self, service: str, there: bool) -> None:
        with self._lock:
            if there:
                self.alive.add(service)
            elif service in self.alive:
                self.alive.discard(service)
                self._record.gone.append(service)
