"""Where captured poses go: a folder of numbered images, or a log."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

import cv2
from numpy.typing import NDArray

from endo3d.schemas.messages import CameraCalibration, Frame, Mode, ProjectorCalibration
from endo3d.services.archive.entry import entry_of
from endo3d.services.archive.facts import host_facts
from endo3d.services.archive.recording import Recording
from endo3d.services.calibration import table
from endo3d.services.calibration.captured import BOARD_FACT
from endo3d.services.runtime.errors import UserError
from endo3d_core import patterns
from endo3d_core.calibrating.boards import Board

Calibration = tuple[CameraCalibration, ProjectorCalibration]


class Writing(Protocol):
    """Takes poses one after the other; the context's end closes it."""

    def pose(self, name: str, columns: Sequence[Frame], rows: Sequence[Frame]) -> None:
        """A pose that was accepted."""

    def white(self, images: Sequence[NDArray[Any]]) -> None:
        """Images of an even light."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


def writing(out: Path, board: Board, calibration: Calibration, simulated: bool) -> Writing:
    """By the name: a log for ``.mcap``, else a folder. Raises ``UserError`` when it is there already."""
    if out.exists() and (out.is_file() or any(out.iterdir())):
        raise UserError(f"{out} exists; remove it, or choose another name")
    if out.suffix == ".mcap":
        return LogWriting(out, board, calibration)
    return FolderWriting(out, board, calibration, simulated)


class FolderWriting:
    """Portable network graphics, as every other program can read them."""

    def __init__(self, out: Path, board: Board, calibration: Calibration, simulated: bool) -> None:
        self._out, self._board, self._simulated = out, board, simulated
        self._projector = calibration[1]
        self._described = False
        out.mkdir(parents=True, exist_ok=True)

    def pose(self, name: str, columns: Sequence[Frame], rows: Sequence[Frame]) -> None:
        if not self._described:
            self._describe(columns[0].pattern_set, rows[0].pattern_set)
        self._images(self._out / name, [frame.image for frame in (*columns, *rows)])

    def white(self, images: Sequence[NDArray[Any]]) -> None:
        self._images(self._out / "white", images)

    def _describe(self, columns: str, rows: str) -> None:
        window = (self._projector.width, self._projector.height)
        head = ""
        if "\nhead:" in self._projector.yaml:
            head = "head.yaml"
            (self._out / head).write_text(self._projector.yaml, encoding="utf-8")
        sets = patterns.parse(columns), patterns.parse(rows)
        text = table.text(self._board, window, sets, head, self._simulated)
        (self._out / table.FILE).write_text(text, encoding="utf-8")
        self._described = True

    @staticmethod
    def _images(folder: Path, images: Sequence[NDArray[Any]]) -> None:
        folder.mkdir()
        for number, image in enumerate(images):
            cv2.imwrite(str(folder / f"{number:02d}.png"), image, (cv2.IMWRITE_PNG_COMPRESSION, 1))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Nothing is open."""


class LogWriting:
    """Frames as they travelled; Mode messages name the poses."""

    def __init__(self, out: Path, board: Board, calibration: Calibration) -> None:
        out.parent.mkdir(parents=True, exist_ok=True)
        self._recording = Recording(out, {**host_facts(), BOARD_FACT: board.text})
        for message in calibration:
            self._recording.put(entry_of(message))

    def pose(self, name: str, columns: Sequence[Frame], rows: Sequence[Frame]) -> None:
        for frames in (columns, rows):
            first = frames[0]
            period_ns = round(1e3 * first.exposure_us)
            mode = Mode(
                first.trigger_ns, name, first.pattern_set, first.epoch, first.trigger_ns, period_ns, first.exposure_us,
                running=True,
            )  # fmt: skip
            self._recording.put(entry_of(mode))
            for frame in frames:
                self._recording.put(entry_of(frame))

    def white(self, images: Sequence[NDArray[Any]]) -> None:
        """A log has none: the flat reference tells the cores too."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._recording.finish()


def frozen(frame: Frame) -> Frame:
    """A copy that outlives the shared memory."""
    return Frame(
        frame.stamp_ns, frame.sequence, frame.image.copy(), frame.pattern_set, frame.slot, frame.epoch,
        frame.exposure_us, frame.trigger_ns, frame.camera_frame_id,
    )  # fmt: skip
