"""Poses of the board from a running stack: every pose along both axes, looked at at once, accepted or not."""

from __future__ import annotations

import queue
import time
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from endo3d.schemas import topics
from endo3d.schemas.messages import (
    CameraCalibration,
    Frame,
    Level,
    LogLine,
    Message,
    Mode,
    ProjectorCalibration,
)
from endo3d.services.calibration.writing import Calibration, frozen
from endo3d.services.runtime.bus import Bus
from endo3d.services.runtime.errors import UserError
from endo3d.services.runtime.service import Refused
from endo3d_core import patterns
from endo3d_core.calibrating.boards import Board
from endo3d_core.calibrating.retina import PixelRetina, Retina
from endo3d_core.calibrating.seeing import View, covered, drawn, share_covered, sight, view
from endo3d_core.calibrating.sighting import Sighting

COLUMNS = "conventional f=50/49/43 steps=4/2/2"
ROWS = f"{COLUMNS} axis=rows"
SAME_PX = 4.0
"""A pose whose features all lie nearer than this to those of an earlier one adds nothing."""
PATIENCE_S = 30.0


@dataclass
class Coverage:
    """What has been accepted so far."""

    board: Board
    retina: Retina
    sightings: list[Sighting] = field(default_factory=list)
    lit: NDArray[np.bool_] | None = None

    def judge(self, seen: View) -> Sighting:
        """Raises ``ValueError`` with the reason when the pose is no use."""
        found = sight(seen, self.board, self.retina)
        for earlier in self.sightings:
            if _same(found, earlier):
                raise ValueError(f"nearly the same as {earlier.name}: move, tilt or turn the board")
        return found

    def add(self, found: Sighting, seen: View) -> None:
        self.sightings.append(found)
        self.lit = seen.lit if self.lit is None else self.lit | seen.lit

    @property
    def share(self) -> float:
        return share_covered(self._cells())

    def drawing(self) -> str:
        """Lines of text: features per cell of the field."""
        return drawn(self._cells())

    def _cells(self) -> NDArray[np.int64]:
        points = self.retina.points if self.lit is None else self.retina.points[self.lit]
        return covered(self.sightings, points)


def _same(one: Sighting, other: Sighting) -> bool:
    at = {tuple(p): pixel for p, pixel in zip(other.board_mm.round(6).tolist(), other.camera_px, strict=True)}
    both = [(pixel, at[tuple(p)]) for p, pixel in zip(one.board_mm.round(6).tolist(), one.camera_px, strict=True)
            if tuple(p) in at]  # fmt: skip
    return bool(both) and max(float(np.hypot(*(a - b))) for a, b in both) < SAME_PX


class LiveCapture:
    """A rig's sequencer and grabber, driven over the bus."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._frames: queue.Queue[Frame] = queue.Queue()
        self._epoch = -1
        self._calibration: dict[type, Message] = {}
        self._before = ""
        for topic in (topics.CAMERA, topics.PROJECTOR, topics.MODE):
            bus.subscribe(topic, self._keep)
        bus.subscribe(topics.FRAME, self._frame)

    def calibration(self) -> Calibration:
        """What the stack calls itself calibrated with: for the sizes. Raises ``UserError``."""
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            camera, projector = map(self._calibration.get, (CameraCalibration, ProjectorCalibration))
            if isinstance(camera, CameraCalibration) and isinstance(projector, ProjectorCalibration):
                return camera, projector
            time.sleep(0.05)
        raise UserError(f"no camera on rig {self._bus.rig}; start the stack first: endo3d up STACK")

    def pose(self, name: str, retina: Retina) -> tuple[list[Frame], list[Frame], View]:
        """Both sequences, and what they show. Raises ``UserError`` when the stack does not deliver them."""
        columns, rows = self._sequence(COLUMNS), self._sequence(ROWS)
        projector = self.calibration()[1]
        seen = view(
            name,
            retina,
            ((frame.image for frame in columns), patterns.parse(COLUMNS).patterns),
            ((frame.image for frame in rows), patterns.parse(ROWS).patterns),
            (projector.width, projector.height),
        )
        return columns, rows, seen

    def retina(self) -> Retina:
        """Pixels: the fibre's cores are found when everything is solved."""
        camera = self.calibration()[0]
        return PixelRetina(camera.width, camera.height)

    def say(self, text: str) -> None:
        """A line that the viewer and the recorder get too."""
        line = LogLine(time.time_ns(), Level.INFO, text, "calibrate")
        self._bus.publish(line)

    def restore(self) -> None:
        """The mode that was shown before."""
        if self._before:
            self._bus.call("sequencer", "mode", {"mode": self._before}, timeout_s=PATIENCE_S)

    def _sequence(self, pattern_set: str) -> list[Frame]:
        try:
            reply = self._bus.call("sequencer", "mode", {"mode": pattern_set}, timeout_s=PATIENCE_S)
        except Refused as refusal:
            raise UserError(f"the sequencer refuses {pattern_set}: {refusal}") from None
        self._epoch = int(reply["epoch"])
        slots: list[Frame] = []
        wanted = len(patterns.parse(pattern_set))
        deadline = time.monotonic() + PATIENCE_S
        while len(slots) < wanted:
            try:
                frame = self._frames.get(timeout=max(0.0, deadline - time.monotonic()))
            except queue.Empty:
                raise UserError(
                    f"no whole sequence came within {PATIENCE_S:g} s ({len(slots)} of {wanted} frames); see endo3d top"
                ) from None
            if frame.epoch != self._epoch:
                continue
            if frame.slot != len(slots):
                slots = []
            if frame.slot == len(slots):
                slots.append(frame)
        self._epoch = -1
        return slots

    def _frame(self, message: Message) -> None:
        assert isinstance(message, Frame)
        if message.epoch == self._epoch:
            self._frames.put(frozen(message))

    def _keep(self, message: Message) -> None:
        if isinstance(message, Mode):
            self._before = self._before or message.mode  # what was shown when we came
        self._calibration[type(message)] = message
