"""Tapping a running rig: endo3d's reader, and the two examples as a user runs them."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from bus_peers import frame
from peers import new_rig

from endo3d.schemas import topics
from endo3d.schemas.messages import POINT, Cloud, Frame
from endo3d.services.runtime.bus import Bus
from endo3d.services.runtime.errors import UserError
from endo3d.services.tap import tap

EXAMPLES = Path(__file__).parents[2] / "examples"


@contextmanager
def rig_at_work() -> Iterator[str]:
    """The name of a rig that publishes frames and clouds."""
    rig, ended = new_rig(), threading.Event()

    def work() -> None:
        points = np.zeros((4, 5), POINT)
        with Bus.open(rig, name="worker") as bus:
            sequence = 0
            while not ended.wait(0.01):
                bus.publish(frame(bus, sequence))
                bus.publish(Cloud(1, sequence, points, 3, 1, 1, "interleaved f1=25", 4.0, valid_count=7))
                sequence += 1

    worker = threading.Thread(target=work)
    worker.start()
    try:
        yield rig
    finally:
        ended.set()
        worker.join()


def test_tap_yields_messages() -> None:
    with rig_at_work() as rig:
        clouds = tap("cloud", rig=rig, timeout_s=90)
        first, second = next(clouds), next(clouds)
        clouds.close()  # type: ignore[attr-defined]
    assert isinstance(first, Cloud)
    assert isinstance(second, Cloud)
    assert first.points.shape == (4, 5)
    assert first.sequence < second.sequence


def test_a_slow_loop_gets_the_newest() -> None:
    with rig_at_work() as rig:
        frames = tap(topics.FRAME, rig=rig, timeout_s=90)
        first = next(frames)
        time.sleep(0.5)
        second = next(frames)
        frames.close()  # type: ignore[attr-defined]
    assert isinstance(first, Frame)
    assert isinstance(second, Frame)
    assert second.sequence > first.sequence + 1, "it was asleep while others came"


def test_a_tap_on_nothing_ends_after_its_timeout() -> None:
    assert list(tap("cloud", rig=new_rig(), timeout_s=0.2)) == []


def test_an_unknown_topic_names_the_known_ones() -> None:
    with pytest.raises(UserError, match="no topic 'clouds'; there are: frame, cloud"):
        next(tap("clouds"))


@pytest.mark.parametrize(
    ("example", "line"),
    [
        ("tap_endo3d.py", "points, 7 valid"),
        ("tap_plain.py", "160 x 120 mono8, 19200 bytes"),
    ],
)
def test_examples_run(example: str, line: str) -> None:
    with rig_at_work() as rig:
        process = subprocess.Popen([sys.executable, EXAMPLES / example, rig], stdout=subprocess.PIPE, text=True)
        try:
            assert process.stdout is not None
            assert line in process.stdout.readline()
        finally:
            process.kill()
            process.communicate()


def test_the_plain_example_needs_no_endo3d() -> None:
    assert "endo3d." not in (EXAMPLES / "tap_plain.py").read_text()
