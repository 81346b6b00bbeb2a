"""Guided capture against a stack that is only a bus: stale frames, sequences begun in the middle, verdicts on poses."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from endo3d.schemas import topics
from endo3d.schemas.messages import CameraCalibration, Frame, LogLine, Message, Mode, ProjectorCalibration
from endo3d.schemas.topics import Topic
from endo3d.services.calibration.capturing import COLUMNS, ROWS, Coverage, LiveCapture
from endo3d_core import patterns
from endo3d_core.calibrating.boards import Board

BOARD = Board.parse("checkerboard 6x5 pitch=1.0")
PX_PER_MM, CORNER_PX = 36.0, 70.0
HEIGHT, WIDTH, WINDOW = 300, 360, 960


class Stack:
    """A bus whose projector and camera show the board, in an endless round that a command changes."""

    rig = "made-up"

    def __init__(self, shift_px: float = 0.0) -> None:
        self.shift_px = shift_px
        self.said: list[Message] = []
        self.asked: list[str] = []
        self._handlers: dict[str, Callable[[Message], None]] = {}
        self._shown, self._epoch = "interleaved f1=15", 1
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._play, daemon=True)

    def subscribe(self, topic: Topic, handler: Callable[[Message], None]) -> None:
        self._handlers[topic.name] = handler
        if topic is topics.CAMERA:
            handler(CameraCalibration(0, WIDTH, HEIGHT, np.eye(3), np.zeros(5)))
        if topic is topics.PROJECTOR:
            handler(ProjectorCalibration(0, WINDOW, WINDOW, np.eye(3), np.zeros(5), np.eye(4)))
        if topic is topics.MODE:
            handler(Mode(0, "hand", self._shown, 1, 0, 7_576_000, 7471.0, running=True))
        if topic is topics.FRAME:
            self._thread.start()

    def publish(self, message: Message) -> None:
        self.said.append(message)

    def call(self, service: str, verb: str, parameters: Mapping[str, Any], timeout_s: float) -> dict[str, Any]:
        assert (service, verb) == ("sequencer", "mode")
        self.asked.append(parameters["mode"])
        self._epoch += 1
        self._shown = parameters["mode"] if parameters["mode"] != "hand" else "interleaved f1=15"
        return {"epoch": self._epoch}

    def _play(self) -> None:
        count = 3  # somewhere in the middle
        while not self._ended.wait(0.002):
            shown, epoch = self._shown, self._epoch
            slot = count % len(patterns.parse(shown))
            image = seen(shown, slot, self.shift_px)
            self._handlers["frame"](Frame(count, count, image, shown, slot, epoch, 7000.0, count, count))
            count += 1

    def end(self) -> None:
        self._ended.set()
        self._thread.join()


@cache
def albedo(shift_px: float) -> NDArray[np.float64]:
    """(height, width) of the board upright before the camera."""
    part = (np.arange(4) - 1.5) / 4
    axes = (np.arange(WIDTH) - shift_px, np.arange(HEIGHT, dtype=np.float64))
    x, y = (((axis[:, None] + part).ravel() - CORNER_PX) / PX_PER_MM for axis in axes)
    return 1.0 - 0.85 * BOARD.dark(x, y[:, None]).reshape(HEIGHT, 4, WIDTH, 4).mean(axis=(1, 3))


@cache
def seen(pattern_set: str, slot: int, shift_px: float) -> NDArray[np.uint8]:
    """The board lit by one pattern."""
    pattern = patterns.parse(pattern_set)[slot]
    u, v = np.arange(WIDTH, dtype=np.float64), np.arange(HEIGHT, dtype=np.float64)
    line = patterns.profile(pattern, 100.0 + 2.0 * (u if pattern.axis == "columns" else v), WINDOW)
    light = line[None, :] if pattern.axis == "columns" else line[:, None]
    return np.rint(albedo(shift_px) * (25.0 + 180.0 * light)).astype(np.uint8)


@pytest.fixture
def stack() -> Iterator[Stack]:
    made = Stack()
    yield made
    made.end()


def test_a_pose_is_taken_whole_judged_and_told(stack: Stack) -> None:
    live = LiveCapture(stack)  # type: ignore[arg-type]
    assert live.calibration()[1].width == WINDOW
    coverage = Coverage(BOARD, live.retina())
    columns, rows, view = live.pose("board_00", coverage.retina)
    assert [frame.slot for frame in columns] == list(range(8))
    assert {frame.pattern_set for frame in rows} == {ROWS}
    assert len({frame.epoch for frame in columns}) == 1
    found = coverage.judge(view)
    expected = CORNER_PX + PX_PER_MM * BOARD.points_mm[:, :2]
    turned = expected[::-1]
    error = min((found.camera_px - truth for truth in (expected, turned)), key=lambda e: float(np.abs(e).max()))
    assert np.abs(error).max() < 0.1
    np.testing.assert_allclose(found.projector_px, 100.0 + 2.0 * found.camera_px, atol=0.3)
    coverage.add(found, view)
    assert 0.1 < coverage.share < 1.0

    again = live.pose("board_01", coverage.retina)[2]
    with pytest.raises(ValueError, match="nearly the same as board_00"):
        coverage.judge(again)
    stack.shift_px = 12.0
    coverage.add(coverage.judge(live.pose("board_01", coverage.retina)[2]), again)

    live.say(f"board_01 accepted\n{coverage.drawing()}")
    line = stack.said[-1]
    assert isinstance(line, LogLine)
    assert line.service == "calibrate"
    assert " 2" in line.message
    live.restore()
    assert stack.asked[:2] == [COLUMNS, ROWS]
    assert stack.asked[-1] == "hand"
