"""What a calibration is made from, wherever it lies: a folder, a log, or the virtual rig."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d.schemas import topics
from endo3d.schemas.messages import CameraCalibration, Frame, Mode, ProjectorCalibration
from endo3d.services.archive.reader import Log
from endo3d.services.calibration.table import FILE, CalibrationTable
from endo3d.services.devices.grey_image import read_grey
from endo3d.services.importing.folder import numbered
from endo3d.services.runtime.errors import UserError
from endo3d.services.runtime.stack_file import stock
from endo3d_core import patterns
from endo3d_core.calibrating.boards import Board
from endo3d_core.calibrating.retina import Retina
from endo3d_core.calibrating.seeing import View, Window, view
from endo3d_core.patterns import Pattern

Images = Callable[[], Iterable[NDArray[Any]]]
"""Reads them one by one: fifteen poses at once would take a gigabyte."""
BOARD_FACT = "calibrate.board"
"""Among the facts of a log that ``calibrate capture`` wrote."""


@dataclass(frozen=True, slots=True)
class Pose:
    """The fringes of both axes on a surface that stood still."""

    name: str
    columns: tuple[Images, tuple[Pattern, ...]]
    rows: tuple[Images, tuple[Pattern, ...]]

    def view(self, retina: Retina, window: Window) -> View:
        """Its images, seen. Raises ``UserError`` that names the pose."""
        try:
            return view(
                self.name, retina, (self.columns[0](), self.columns[1]), (self.rows[0](), self.rows[1]), window
            )
        except ValueError as error:
            raise UserError(f"pose {self.name}: {error}") from error


@dataclass(frozen=True, slots=True)
class Captured:
    """All of it."""

    board: Board
    size: tuple[int, int]
    """Width and height of the camera's images."""
    window: Window
    boards: list[Pose]
    flats: list[Pose] = field(default_factory=list)
    white: NDArray[np.float32] | None = None
    """(height, width) mean image of an even light, to find a fibre's cores in."""
    head_yaml: str = ""
    """A head's file, for its design figures."""
    simulated: bool = False


def captured(source: Path, board: str = "") -> Captured:
    """From a folder with capture.toml or a log. Raises ``UserError`` that says what is wrong."""
    if source.is_dir():
        return of_folder(source)
    if source.suffix == ".mcap" and source.exists():
        return of_log(source, board)
    raise UserError(f"{source} is neither a folder with {FILE} nor a log (.mcap); see endo3d calibrate capture")


def of_folder(folder: Path) -> Captured:
    """Sub-folders of numbered images, described by ``capture.toml``."""
    table = CalibrationTable.read(folder / FILE)
    board_folders, flat_folders = (
        sorted(path for path in folder.glob(name) if path.is_dir()) for name in (table.boards, table.flats)
    )
    if not board_folders:
        raise UserError(f"{folder} has no sub-folder {table.boards!r}; one per pose of the board is needed")
    poses = {path: _pose(path, table) for path in (*board_folders, *flat_folders)}
    first = _read(numbered(board_folders[0], table.images)[0])
    white = folder / table.white
    images = numbered(white) if white.is_dir() else []
    mean = np.mean([_read(path).astype(np.float32) for path in images], axis=0) if images else None
    if mean is not None and mean.shape != first.shape:
        raise UserError(f"{white}: {mean.shape[::-1]} px, the poses have {first.shape[::-1]}; take all with one format")
    return Captured(
        Board.parse(table.board),
        (first.shape[1], first.shape[0]),
        table.projector,
        [poses[path] for path in board_folders],
        [poses[path] for path in flat_folders],
        mean,
        head_text(table.head, folder),
        table.simulated,
    )


def head_text(head: str, folder: Path = Path()) -> str:
    """A stock head's file by its name, or any file. Raises ``UserError``."""
    if not head:
        return ""
    path = stock("heads").get(head, folder / head)
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        known = ", ".join(stock("heads"))
        raise UserError(f"head {head!r}: {error.strerror}; name a file, or one of: {known}") from None


def _pose(folder: Path, table: CalibrationTable) -> Pose:
    paths = numbered(folder, table.images)
    if len(paths) != len(table.pattern):
        raise UserError(f"{folder} holds {len(paths)} images, {FILE} lists {len(table.pattern)} patterns")
    sides = []
    for axis in ("columns", "rows"):
        places, shown = table.of_axis("columns" if axis == "columns" else "rows")
        sides.append((_reader([paths[i] for i in places]), shown))
    return Pose(folder.name, sides[0], sides[1])


def _reader(paths: list[Path]) -> Images:
    def images() -> Iterator[NDArray[Any]]:
        for path in paths:
            yield _read(path)

    return images


def _read(path: Path) -> NDArray[Any]:
    try:
        return read_grey(path)
    except ValueError as error:
        raise UserError(str(error)) from None


def of_log(path: Path, board_text: str = "") -> Captured:
    """Every whole sequence along the columns that is followed by one along the rows is a pose.

    ``calibrate capture`` names them in its Mode messages; in another recording all poses are the board's.
    """
    log = Log(path)
    text = board_text or log.facts.get("endo3d", {}).get(BOARD_FACT, "")
    if not text:
        raise UserError(f"{path} does not say which board it shows; name it: --board 'checkerboard 9x7 pitch=1.0'")
    try:
        board = Board.parse(text)
    except ValueError as error:
        raise UserError(str(error)) from None
    camera = next((m for m in log.messages(topics.CAMERA) if isinstance(m, CameraCalibration)), None)
    projector = next((m for m in log.messages(topics.PROJECTOR) if isinstance(m, ProjectorCalibration)), None)
    if camera is None or projector is None:
        raise UserError(f"{path} holds no calibration messages: the size of the projector is not known")
    names = {m.epoch: m.mode for m in log.messages(topics.MODE) if isinstance(m, Mode)}
    poses = _poses(log, names)
    if not poses:
        raise UserError(
            f"{path} holds no pose: whole sequences along the columns and then along the rows; "
            "see endo3d calibrate capture"
        )
    return Captured(
        board,
        (camera.width, camera.height),
        (projector.width, projector.height),
        [pose for pose in poses if not pose.name.startswith("flat")],
        [pose for pose in poses if pose.name.startswith("flat")],
        head_yaml=projector.yaml,
        simulated=log.count(topics.TRUTH) > 0,
    )


@dataclass(frozen=True, slots=True)
class _Sequence:
    """A whole run through a pattern set."""

    epoch: int
    pattern_set: str
    start_ns: int
    end_ns: int


def _poses(log: Log, names: dict[int, str]) -> list[Pose]:
    whole = _whole_sequences(log)
    found = []
    for first, second in itertools.pairwise(whole):
        if patterns.parse(first.pattern_set).axis == "columns" and patterns.parse(second.pattern_set).axis == "rows":
            name = names.get(first.epoch, "")
            name = name if name.startswith(("board", "flat")) else f"epoch_{first.epoch}"
            found.append(Pose(name, _frames(log, first), _frames(log, second)))
    return found


def _whole_sequences(log: Log) -> list[_Sequence]:
    """The first whole one of each epoch, without uninteresting ones of the continuous mode."""
    found: dict[int, _Sequence] = {}
    slots: list[Frame] = []
    for message in log.messages(topics.FRAME):
        if not isinstance(message, Frame) or message.pattern_set.startswith("interleaved") or message.epoch in found:
            continue
        if message.slot != len(slots) or (slots and slots[0].epoch != message.epoch):
            slots = []
        if message.slot == len(slots):
            slots.append(message)
        if len(slots) == len(patterns.parse(message.pattern_set)):
            begin, end = slots[0].stamp_ns, slots[-1].stamp_ns
            found[message.epoch] = _Sequence(message.epoch, message.pattern_set, begin, end)
            slots = []
    return list(found.values())


def _frames(log: Log, sequence: _Sequence) -> tuple[Images, tuple[Pattern, ...]]:
    def images() -> Iterator[NDArray[Any]]:
        for message in log.messages(topics.FRAME):
            inside = sequence.start_ns <= message.stamp_ns <= sequence.end_ns
            if isinstance(message, Frame) and message.epoch == sequence.epoch and inside:
                yield message.image

    return images, patterns.parse(sequence.pattern_set).patterns
