"""``endo3d view``: a log in Rerun, or a picture of it."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer

from endo3d.services.runtime.errors import UserError

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from endo3d.services.archive.reader import Log
    from endo3d.services.views.display import Display
    from endo3d.services.views.scan import Scan

COLOURS = ("height", "quality", "deviation")


def view(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="A log, LOG.mcap.")],
    picture: Annotated[
        Path | None, typer.Option("--picture", metavar="PNG", help="Write a picture; needs no screen.")
    ] = None,
    rrd: Annotated[
        Path | None, typer.Option("--rrd", metavar="RRD", help="Write a Rerun recording, and open nothing.")
    ] = None,
    colour: Annotated[str, typer.Option("--colour", help="height, quality or deviation from the truth.")] = "height",
    web: Annotated[bool, typer.Option("--web", help="A page for browsers on this machine, not a window.")] = False,
    by_rerun: Annotated[
        bool, typer.Option("--rerun", help="With --picture: as Rerun shows it, not as endo3d draws it.")
    ] = False,
) -> None:
    """Show a log in Rerun: merged cloud, way of the tip, frustum, image, depth map, plots.

    Examples: endo3d view scan.mcap; endo3d view scan.mcap --picture scan.png --colour deviation
    """
    from endo3d.services.archive.reader import Log

    if colour not in COLOURS:
        raise UserError(f"no colouring {colour!r}; choose {', '.join(COLOURS)}")
    opened = Log(log)
    if picture is not None:
        _draw(opened, picture, colour, by_rerun)
    if rrd is not None:
        _write(opened, rrd, colour)
    if picture is None and rrd is None:
        _open(opened, colour, web)


def _draw(log: Log, path: Path, colour: str, by_rerun: bool) -> None:
    from endo3d.services.views.picture import picture
    from endo3d.services.views.scan import Scan

    if by_rerun:
        from endo3d.services.views.headless import rerun_picture

        with TemporaryDirectory() as folder:
            recording = Path(folder) / "log.rrd"
            _write(log, recording, colour)
            rerun_picture(recording, path)
        return
    scan = Scan.of_log(log)
    deviation_um = _deviation(scan)(scan.points()) if colour == "deviation" else None
    picture(scan, path, colour=colour, deviation_um=deviation_um)


def _deviation(scan: Scan) -> Callable[[NDArray[Any]], NDArray[np.float64]]:
    """Distances of map points from the truth, the trajectory of the whole log laid onto the true one."""
    from endo3d.services.cli.truth import compare

    def deviation_um(points: NDArray[Any]) -> NDArray[np.float64]:
        comparison = compare(scan.poses, scan.truths, points)
        if comparison is None:
            raise UserError("deviation needs a simulated log with tracked poses; choose --colour height")
        return comparison.deviation_um

    return deviation_um


def _display(log: Log, colour: str) -> Display:
    from endo3d.schemas import topics
    from endo3d.services.views.display import Display
    from endo3d.services.views.recording import CLOUD_HZ, MAP_HZ, RATE_HZ
    from endo3d.services.views.scan import Scan

    if colour != "deviation":
        return Display(RATE_HZ, CLOUD_HZ, MAP_HZ, colour)
    known = Scan.of(log.messages(topics.POSE, topics.TRUTH))
    return Display(RATE_HZ, CLOUD_HZ, MAP_HZ, colour, _deviation(known))


def _write(log: Log, path: Path, colour: str) -> None:
    from endo3d.services.views.recording import write_rrd

    write_rrd(log.messages(), path, _display(log, colour))


def _open(log: Log, colour: str, web: bool) -> None:
    """Fill a viewer with the log, and stay until it is closed."""
    from endo3d.services.views.blueprint import scan_blueprint
    from endo3d.services.views.recording import play
    from endo3d.services.views.sink import ViewerSink
    from endo3d.services.views.viewer_process import ViewerProcess, has_display

    if not web and not has_display():
        raise UserError("no display here: endo3d view LOG --web, --picture PNG or --rrd RRD")
    viewer = ViewerProcess(web_port=0 if web else None)
    try:
        if web:
            print(f"open {viewer.page} (Ctrl-C ends it)", flush=True)
        sink = ViewerSink(viewer.url, scan_blueprint(), patience_s=60.0)
        play(log.messages(), sink, _display(log, colour))
        sink.close()
        viewer.wait()
    except KeyboardInterrupt:
        pass
    finally:
        viewer.stop()
