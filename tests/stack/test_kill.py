"""The demo's stack with real processes: whoever is killed comes back, and the archive stays whole."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from endo3d.schemas import topics
from endo3d.schemas.messages import Cloud, Message, Pose, ServiceState, Status
from endo3d.services.archive.reader import Log
from endo3d.services.runtime import stack_file
from endo3d.services.runtime.bus import Bus
from endo3d.services.runtime.launcher import Launcher, State, children_of

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

SERVICES = ("sequencer", "grabber", "decoder", "odometry", "recorder", "viewer")
START_LIMIT_S = 240.0
"""The first start on a machine compiles every kernel."""
RECOVERY_LIMIT_S = 150.0


class Stack:
    """A running stack, and what comes out of it."""

    def __init__(self, launcher: Launcher, bus: Bus) -> None:
        self.launcher = launcher
        self.newest: dict[str, Message] = {}
        self.statuses: dict[str, Status] = {}
        self.lock = threading.Lock()
        for topic in (topics.CLOUD, topics.POSE, topics.STATUS):
            bus.subscribe(topic, self._take)

    def _take(self, message: Message) -> None:
        with self.lock:
            if isinstance(message, Status):
                self.statuses[message.service] = message
            else:
                self.newest[topics.of(message).name] = message

    def until(self, condition: Callable[[], bool], limit_s: float, what: str) -> float:
        """Turn the launcher until ``condition``; the seconds it took."""
        began_s = time.monotonic()
        while not condition():
            assert time.monotonic() - began_s < limit_s, f"{what}: not within {limit_s} s"
            self.launcher.turn(0.05)
        return time.monotonic() - began_s

    def flows_after(self, stamp_ns: int) -> bool:
        """Clouds and poses of frames that were exposed after ``stamp_ns`` have come."""
        with self.lock:
            cloud, pose = self.newest.get("cloud"), self.newest.get("pose")
        return (
            isinstance(cloud, Cloud)
            and isinstance(pose, Pose)
            and min(cloud.stamp_ns, pose.stamp_ns) > stamp_ns
        )

    def pid(self, service: str) -> int:
        return next(child.pid or 0 for child in self.launcher.children if child.name == service)

    def runs_as(self, service: str, pid: int) -> bool:
        with self.lock:
            status = self.statuses.get(service)
        return status is not None and status.pid == pid and status.state is not ServiceState.STARTING


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("faults")


@pytest.fixture(scope="module")
def stack(folder: Path) -> Iterator[Stack]:
    settings = [f"rig.name=faults{os.getpid()}", f"recorder.directory={folder}", "recorder.name=scan"]
    # A busy machine has to start a service while it holds this rate.
    settings += ["viewer.show=none", f"viewer.save={folder / 'scan.rrd'}", "sequencer.rate_hz=5"]
    settings += ["grabber.camera=sim:contour texture=noise:0.15:0.15?motion=hand seed=7&bin=4&slow_motion=34.4"]
    described = stack_file.load("demo", settings)
    assert {"sequencer", "grabber", "decoder", "odometry", "recorder", "viewer"} == set(described.tables)
    with (
        Bus.open(described.rig.name, name="test") as bus,
        Launcher(children_of(described, settings), lambda name, line: print(name, line)) as launcher,
    ):
        launcher.start()
        running = Stack(launcher, bus)
        running.until(lambda: running.flows_after(0), START_LIMIT_S, "first cloud and pose")
        yield running


@pytest.mark.parametrize("service", SERVICES)
def test_a_killed_service_comes_back_and_the_stream_goes_on(stack: Stack, service: str) -> None:
    stack.until(lambda: stack.runs_as(service, stack.pid(service)), RECOVERY_LIMIT_S, f"{service} runs")
    others = {name: stack.pid(name) for name in SERVICES if name != service}
    victim = stack.pid(service)
    os.kill(victim, signal.SIGKILL)
    stack.until(lambda: stack.pid(service) not in (0, victim), RECOVERY_LIMIT_S, f"{service} started again")
    stack.until(lambda: stack.runs_as(service, stack.pid(service)), RECOVERY_LIMIT_S, f"{service} runs again")
    back_ns = time.time_ns()
    stack.until(
        lambda: stack.flows_after(back_ns), RECOVERY_LIMIT_S, f"clouds and poses after {service} came back"
    )
    assert {name: stack.pid(name) for name in others} == others, "nobody else was disturbed"


def test_the_archive_is_whole_and_nothing_is_left_running(stack: Stack, folder: Path) -> None:
    """Runs last: two readable logs, every frame in them once, every chunk undamaged."""
    pids = [stack.pid(name) for name in SERVICES]
    stack.launcher.stop()
    assert all(child.state is State.STOPPED for child in stack.launcher.children)
    assert not any(psutil.pid_exists(pid) for pid in pids)
    logs = sorted((Log(path) for path in folder.glob("*.mcap")), key=lambda log: log.start_ns)
    assert len(logs) == 2, "one until the recorder was killed, one from then on"
    stamps_ns = [frame.stamp_ns for log in logs for frame in log.messages(topics.FRAME)]
    assert len(stamps_ns) == len(set(stamps_ns)) > 30
    for log in logs:
        assert {"stack.toml", "calibration.yaml"} <= set(log.attachments)
        recorded = [
            topic.name for topic in (topics.FRAME, topics.CLOUD, topics.POSE, topics.MAP) if log.count(topic)
        ]
        assert recorded == ["frame", "cloud", "pose", "map"]
        assert sum(1 for _ in log.records(check=True)) > 0
    gap_s = 1e-9 * (logs[1].start_ns - logs[0].end_ns)
    assert 0.0 < gap_s < RECOVERY_LIMIT_S, "the second log begins when the recorder is back"
