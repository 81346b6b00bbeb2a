"""What a consumer at the end of the bus sees of a run: latencies, and how the services say they do."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

import numpy as np

from endo3d.schemas import topics
from endo3d.schemas.messages import Cloud, Message, Pose, ServiceState, Status
from endo3d.services.runtime.bus import Bus


@dataclass(frozen=True)
class Triggers:
    """What a camera made of them, since its start."""

    taken: int = 0
    missed: int = 0

    def missed_share(self, before: Triggers) -> float:
        """Since ``before``; 0 of none."""
        missed = self.missed - before.missed
        return missed / max(1, missed + self.taken - before.taken)


class Watch:
    """Listens to clouds, poses and statuses; everything may be read at any time."""

    def __init__(self, bus: Bus) -> None:
        self.clouds = 0
        self.poses = 0
        self.first_cloud_s = 0.0
        """``time.monotonic()`` of the first cloud."""
        self.cloud_latency_ms: list[float] = []
        """Mid-exposure of the newest frame involved -> the cloud in this process."""
        self.pose_latency_ms: list[float] = []
        self.valid_share = 0.0
        self.tracking = ""
        self.statuses: dict[str, Status] = {}
        self._cpu_shares: dict[str, list[float]] = {}
        """Of every second in which a service worked."""
        self._arrival = threading.Condition()
        bus.subscribe(topics.CLOUD, self._cloud)
        bus.subscribe(topics.POSE, self._pose)
        bus.subscribe(topics.STATUS, self._status)

    def _cloud(self, message: Message) -> None:
        assert isinstance(message, Cloud)
        with self._arrival:
            self.cloud_latency_ms.append(1e-6 * (time.time_ns() - message.newest_stamp_ns))
            self.valid_share = message.valid_count / message.points.size
            self.first_cloud_s = self.first_cloud_s or time.monotonic()
            self.clouds += 1
            self._arrival.notify_all()

    def _pose(self, message: Message) -> None:
        assert isinstance(message, Pose)
        self.pose_latency_ms.append(1e-6 * (time.time_ns() - (message.newest_stamp_ns or message.stamp_ns)))
        self.tracking = str(message.state)
        self.poses += 1

    def _status(self, message: Message) -> None:
        assert isinstance(message, Status)
        with self._arrival:
            self.statuses[message.service] = message
            if message.state is not ServiceState.STARTING:
                self._cpu_shares.setdefault(message.service, []).append(message.cpu_share)
            self._arrival.notify_all()

    def starting(self, services: list[str]) -> list[str]:
        """Those that have not said they are ready."""
        return [
            name for name in services if name not in self.statuses or self.statuses[name].state is ServiceState.STARTING
        ]

    def triggers(self, service: str) -> Triggers:
        """As the service that takes the frames last said."""
        if service not in self.statuses:
            return Triggers()
        status = self.statuses[service]
        return Triggers(status.published.get(topics.FRAME.name, 0), status.dropped.get("trigger:missed", 0))

    def rate_hz(self, service: str) -> float:
        return self.statuses[service].rate_hz if service in self.statuses else 0.0

    def loads(self) -> dict[str, dict[str, float]]:
        """service -> mean share of a core and last memory."""
        return {
            name: {"cpu_percent": 100 * float(np.mean(shares)), "memory_mb": self.statuses[name].memory_mb}
            for name, shares in sorted(self._cpu_shares.items())
        }

    def lost(self) -> dict[str, dict[str, int]]:
        """service -> cause -> count, of everything that was lost."""
        return {
            name: {cause: count for cause, count in status.dropped.items() if count}
            for name, status in sorted(self.statuses.items())
            if any(status.dropped.values())
        }


def percentiles_ms(latencies_ms: list[float]) -> dict[str, float]:
    """p50 and p99; NaN of nothing."""
    if not latencies_ms:
        return {"p50": float("nan"), "p99": float("nan")}
    p50, p99 = np.percentile(latencies_ms, (50, 99))
    return {"p50": float(p50), "p99": float(p99)}
