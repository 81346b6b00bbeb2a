"""What ``endo3d calibrate capture`` does: guide somebody who holds a board, or render poses."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from endo3d_core.calibrating.boards import Board

HINTS = (
    "fronto-parallel, in the middle",
    "tilted to the left",
    "tilted to the right",
    "tilted away",
    "tilted towards the sensor",
    "near, a corner of the field",
    "far, the opposite corner",
    "near, another corner",
    "far, the last corner",
    "turned by a right angle, in the middle",
)


def render(out: Path, board: Board, head: str, poses: int, flats: int) -> None:
    """The poses of a patient operator, on the virtual rig."""
    from rich.console import Console
    from rich.progress import Progress

    from endo3d.schemas.messages import CameraCalibration, ProjectorCalibration
    from endo3d.services.calibration.captured import head_text
    from endo3d.services.calibration.virtual import COLUMNS, ROWS, VirtualCapture
    from endo3d.services.calibration.writing import writing

    virtual = VirtualCapture(head_text(head), board, poses, flats)
    run = virtual.run("plane", COLUMNS)
    camera, projector = run.calibration()
    assert isinstance(camera, CameraCalibration)
    assert isinstance(projector, ProjectorCalibration)
    progress = Progress(console=Console(stderr=True))
    with writing(out, board, (camera, projector), simulated=True) as into, progress as bar:
        task = bar.add_task("rendering (simulated)", total=poses + flats)
        into.white(virtual.whites())
        for epoch, (name, scene) in enumerate(virtual.scenes()):
            sides = [virtual.frames(scene, text, 2 * epoch + k + 1) for k, text in enumerate((COLUMNS, ROWS))]
            into.pose(name, *sides)
            bar.update(task, advance=1)
    print(f"written: {out}, {poses} poses of {board.text} and {flats} of a plane, simulated")


def guide(out: Path, board: Board, rig: str, poses: int, flats: int, every_s: float, tries: int) -> None:
    """Ask for pose after pose, and say of each whether it helps."""
    from endo3d.services.calibration.capturing import Coverage, LiveCapture
    from endo3d.services.calibration.writing import writing
    from endo3d.services.cli.control import join
    from endo3d.services.runtime.errors import UserError

    with join(rig) as bus:
        live = LiveCapture(bus)
        calibration = live.calibration()
        retina = live.retina()
        coverage = Coverage(board, retina)
        rejected = 0
        with writing(out, board, calibration, simulated=False) as into:
            try:
                while len(coverage.sightings) < poses:
                    name = f"board_{len(coverage.sightings):02d}"
                    _ask(f"{name}: {board.text}, {HINTS[len(coverage.sightings) % len(HINTS)]}", every_s)
                    columns, rows, seen = live.pose(name, retina)
                    try:
                        found = coverage.judge(seen)
                    except ValueError as error:
                        rejected += 1
                        live.say(_told(f"{name} rejected: {error}"))
                        if rejected >= tries:
                            raise UserError(f"{tries} poses in a row were rejected, the last: {error}") from None
                        continue
                    rejected = 0
                    coverage.add(found, seen)
                    into.pose(name, columns, rows)
                    live.say(_told(
                        f"{name} accepted: {len(found.board_mm)} features, {coverage.share:.0%} of the field, "
                        f"{len(coverage.sightings)} of {poses} poses\n{coverage.drawing()}"
                    ))  # fmt: skip
                for number in range(flats):
                    name = f"flat_{number:02d}"
                    where = ("near", "middle", "far")[number % 3]
                    _ask(f"{name}: a plane, matt surface that fills the field, {where}", every_s)
                    columns, rows, _ = live.pose(name, retina)
                    into.pose(name, columns, rows)
                    live.say(_told(f"{name} taken"))
            finally:
                live.restore()
    print(f"written: {out}; next: endo3d calibrate solve {out} -o rig.yaml")


def _ask(what: str, every_s: float) -> None:
    if every_s > 0:
        print(f"{what} (in {every_s:g} s)", flush=True)
        time.sleep(every_s)
    else:
        input(f"{what}; hold still, then Enter: ")


def _told(text: str) -> str:
    print(text, flush=True)
    return text
