"""``endo3d calibrate``: from poses of a board to a calibrated rig, and its acceptance."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from endo3d.services.cli.options import JsonOption, RigOption

if TYPE_CHECKING:
    from endo3d.services.calibration.captured import Captured
    from endo3d.services.calibration.solving import Calibrated
    from endo3d_core.calibration import Rig

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)

DEFAULT_BOARD = "charuco 11x9 pitch=1.1 marker=0.85"
SourceArgument = Annotated[
    Path, typer.Argument(metavar="FOLDER|LOG", help="Numbered images per pose and capture.toml, or a log.")
]
RigFileArgument = Annotated[Path, typer.Argument(metavar="RIG.yaml", help="A calibration.")]
BoardOption = Annotated[str, typer.Option("--board", help="Like 'checkerboard 9x7 pitch=1.0'; lengths in mm.")]


@app.command()
def capture(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for images, or a log (.mcap).")],
    board: BoardOption = DEFAULT_BOARD,
    poses: Annotated[int, typer.Option(min=1, help="Poses of the board to accept.")] = 15,
    flats: Annotated[int, typer.Option(min=0, help="Poses of a plane surface after them.")] = 3,
    virtual: Annotated[
        str, typer.Option("--virtual", metavar="HEAD", help="Render the poses with a head of the virtual rig instead.")
    ] = "",
    every_s: Annotated[
        float, typer.Option("--every", help="Seconds between poses, instead of waiting for Enter; 0 waits.")
    ] = 0.0,
    tries: Annotated[int, typer.Option(min=1, help="Rejected poses in a row before it gives up.")] = 20,
    rig: RigOption = "demo",
) -> None:
    """Take poses of a board, guided: each along both axes, looked at at once, accepted or rejected with the reason.

    The stack must run. Coverage is drawn here and in the viewer's log.

    Examples: endo3d calibrate capture -o poses --board 'checkerboard 9x7 pitch=1.0';
    endo3d calibrate capture -o poses --virtual base6_wd20
    """
    from endo3d.services.runtime.errors import UserError
    from endo3d_core.calibrating.boards import Board

    try:
        printed = Board.parse(board)
    except ValueError as error:
        raise UserError(str(error)) from None
    if virtual:
        from endo3d.services.cli.calibrate_capture import render

        render(out, printed, virtual, poses, flats)
    else:
        from endo3d.services.cli.calibrate_capture import guide

        guide(out, printed, rig, poses, flats, every_s, tries)


@app.command()
def solve(
    source: SourceArgument,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="RIG.yaml", help="The calibration to write.")],
    board: BoardOption = "",
    head: Annotated[
        str, typer.Option("--head", help="A stock head or file whose design figures the result takes over.")
    ] = "",
    force: Annotated[
        bool, typer.Option("--force", help="Write a bad calibration too; every log will say that it is bad.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Find both lenses, the transform between them, the response, the fibre's cores and the remaining bow.

    A folder holds one sub-folder of numbered images per pose (board_*, flat_*, and white for an even light) and
    capture.toml:

    \b
      board = "charuco 11x9 pitch=1.1 marker=0.85"
      projector = [960, 960]
      [[pattern]]
      axis = "columns"
      f = 50
      shift = 0.0
      ...

    Beside RIG.yaml: RIG.html with pictures, RIG.json, and RIG.fibre.npz where there is a fibre.
    A bad calibration is refused, with the reason. Example: endo3d calibrate solve poses -o rig.yaml
    """
    from endo3d.services.calibration import report
    from endo3d.services.calibration.captured import captured, head_text
    from endo3d.services.runtime.errors import UserError

    if out.suffix not in (".yaml", ".yml"):
        raise UserError(f"{out} is no name for a calibration; it ends in .yaml")
    taken = captured(source, board)
    found = _solved(taken, quiet=as_json)
    out.parent.mkdir(parents=True, exist_ok=True)
    page = report.write(found, out, simulated=taken.simulated)
    if found.quality.state == "bad" and not force:
        raise UserError(f"refused: {found.quality.reason}; see {page}, or take it as it is with --force")
    section = _head_section(head_text(head) or taken.head_yaml)
    if found.core_map is not None:
        cores = out.with_suffix(".fibre.npz")
        cores.write_bytes(found.core_map.to_npz())
        section = _with_core_map(section, cores.name)
    out.write_text(found.yaml(section), encoding="utf-8")
    if as_json:
        print(out.with_suffix(".json").read_text(encoding="utf-8"))
        return
    for note in found.notes:
        print(note)
    print(found.quality.line)
    if not section:
        print("no head section (--head): the decoder then needs z_min_mm and z_max_mm")
    print(f"written: {out}, {page}, in {found.seconds:.1f} s")


@app.command()
def verify(
    rig_file: RigFileArgument,
    source: SourceArgument,
    sphere: Annotated[
        float, typer.Option("--sphere", metavar="MM", help="Calibrated diameter of the sphere that is shown.")
    ] = 0.0,
    limit_um: Annotated[float, typer.Option("--limit", help="Largest error that passes, um.")] = 50.0,
    stamp: Annotated[bool, typer.Option("--stamp", help="Write the verdict into RIG.yaml.")] = False,
) -> None:
    """Measure a plane, or a sphere of known diameter, and say pass or fail after VDI/VDE 2634 part 2.

    The poses are those of the source's flats (plane) or all of them (--sphere). Exit code 1 is a fail.

    Examples: endo3d calibrate verify rig.yaml poses; endo3d calibrate verify rig.yaml ball --sphere 2.0004
    """
    from dataclasses import replace
    from datetime import date

    from endo3d.services.calibration.captured import captured
    from endo3d.services.calibration.verifying import probe
    from endo3d.services.runtime.errors import UserError
    from endo3d_core.calibrating.quality import Quality
    from endo3d_core.head import Head

    text, rig = _rig(rig_file)
    taken = captured(source, "checkerboard 9x7 pitch=1.0")
    poses = [*taken.boards, *taken.flats] if sphere else taken.flats
    if not poses:
        raise UserError(f"{source} holds no flat reference (flat_*); take one, or name a sphere with --sphere")
    try:
        head = Head.from_yaml(text)
    except ValueError as error:
        raise UserError(f"{rig_file}: {error}") from None
    kind: Literal["sphere", "plane"] = "sphere" if sphere else "plane"
    results = list(probe(rig, poses, (head.z_min_mm, head.z_max_mm), kind, limit_um, sphere))
    for result in results:
        print(result.line)
    passed = all(result.passed for result in results)
    worst = max(result.range_um for result in results)
    verdict = f"{'pass' if passed else 'FAIL'}, {kind}, range {worst:.1f} um, limit {limit_um:g} um"
    print(f"VDI/VDE 2634-2: {verdict}")
    if stamp:
        quality = replace(Quality.from_yaml(text), verified=f"{verdict} ({date.today().isoformat()})")
        rig_file.write_text(rig.to_yaml() + quality.to_yaml() + _head_section(text), encoding="utf-8")
    if not passed:
        raise typer.Exit(1)


@app.command()
def export(
    rig_file: RigFileArgument,
    opencv: Annotated[
        Path | None, typer.Option("--opencv", metavar="FILE", help="For cv2.FileStorage (.yaml, .xml).")
    ] = None,
    ros: Annotated[
        Path | None, typer.Option("--ros", metavar="FOLDER", help="camera_info files: camera.yaml, projector.yaml.")
    ] = None,
) -> None:
    """Write a calibration for other programs. Example: endo3d calibrate export rig.yaml --opencv cv.yaml --ros info"""
    from endo3d.services.calibration.exporting import write_camera_info, write_opencv
    from endo3d.services.runtime.errors import UserError

    _, rig = _rig(rig_file)
    if opencv is None and ros is None:
        raise UserError("nothing to write; give --opencv FILE or --ros FOLDER")
    written = []
    if opencv is not None:
        write_opencv(rig, opencv)
        written.append(opencv)
    if ros is not None:
        written += write_camera_info(rig, ros)
    print("written:", ", ".join(map(str, written)))
    if rig.bow.coefficients:
        print("the correction of the bow has no place in these files: they hold the lenses only")


def _solved(taken: Captured, *, quiet: bool) -> Calibrated:
    from rich.console import Console
    from rich.progress import Progress

    from endo3d.services.calibration.solving import poses_of
    from endo3d.services.calibration.solving import solve as solve_all

    with Progress(console=Console(stderr=True), disable=quiet) as bar:
        task = bar.add_task("solving", total=len(poses_of(taken)))
        return solve_all(taken, lambda line: bar.update(task, advance=1))


def _rig(path: Path) -> tuple[str, Rig]:
    from endo3d.services.runtime.errors import UserError
    from endo3d_core.calibration import Rig

    try:
        text = path.read_text(encoding="utf-8")
        return text, Rig.from_yaml(text)
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}; name a calibration file") from None
    except ValueError as error:
        raise UserError(f"{path}: {error}") from None


def _head_section(text: str) -> str:
    """The head's design figures of a file, as they stand there."""
    return text[text.index("\nhead:") + 1 :] if "\nhead:" in text else ""


def _with_core_map(section: str, name: str) -> str:
    """The section, naming the file with the fibre's cores."""
    lines = [line for line in section.splitlines() if not line.strip().startswith("core_map:")]
    at = next((i for i, line in enumerate(lines) if line.strip() == "fibre:"), None)
    if at is not None:
        indent = " " * (len(lines[at]) - len(lines[at].lstrip()) + 2)
        lines.insert(at + 1, f"{indent}core_map: {name}")
    return "\n".join([*lines, ""]) if lines else ""
