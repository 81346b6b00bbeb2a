"""``endo3d import``: images of another instrument as a log."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def import_(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Numbered images, and capture.toml.")],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="LOG", help="The log (.mcap) to write.")],
    capture: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Description of the images; by default capture.toml there.")
    ] = None,
) -> None:
    """Turn a folder of fringe images into a log, which then decodes like any other.

    The images (png, tif, bmp; 8 or 16 bit) are numbered in the order of the patterns. What they show stands in
    capture.toml: the calibration file, rate_hz, repeat, and per pattern f (periods over the projector, or
    pitch_px) and shift (rad), with the intensity 1/2 + 1/2 cos(2 pi f x / N + shift) at projector pixel x of N.

    Example: endo3d import shots -o shots.mcap; endo3d replay shots.mcap --out cloud.mcap;
    endo3d export cloud.mcap --cloud cloud.ply --depth depth.npy --phase phase.npy
    """
    from rich.console import Console
    from rich.progress import track

    from endo3d.services.archive.entry import STACK_FILE, Attachment, entry_of
    from endo3d.services.archive.facts import host_facts
    from endo3d.services.archive.recording import Recording
    from endo3d.services.importing.capture import FILE, Capture
    from endo3d.services.importing.folder import images, numbered
    from endo3d.services.importing.frames import calibration, frames, stack_toml
    from endo3d.services.runtime.errors import UserError

    described = Capture.read(capture or folder / FILE)
    paths = numbered(folder, described.table.images)
    expected = described.table.repeat * len(described.table.pattern)
    if len(paths) != expected:
        raise UserError(
            f"{folder} holds {len(paths)} images, capture.toml describes {expected} "
            f"({len(described.table.pattern)} patterns x {described.table.repeat}); correct the list or repeat"
        )
    if out.exists():
        raise UserError(f"{out} exists; remove it, or choose another name")
    start_ns = paths[0].stat().st_mtime_ns
    stack = Attachment(STACK_FILE, "application/toml", stack_toml(described).encode())
    recording = Recording(out, {**host_facts(), "imported_from": folder.name}, [stack])
    try:
        lens = described.rig.camera
        shots = track(images(paths, (lens.height, lens.width)), "importing", len(paths), console=Console(stderr=True))
        for message in (*calibration(described, start_ns), *frames(described, shots, start_ns)):
            recording.put(entry_of(message))
    except BaseException:
        recording.finish()
        for part in recording.parts:
            part.unlink(missing_ok=True)
        raise
    recording.finish()
    print(f"{out}: {len(paths)} frames of {', '.join(shown.text for shown in described.sets)}")
