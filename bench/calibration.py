"""What a calibration of the virtual rig is worth, with all physics: ``python -m bench.calibration``.

Poses are rendered into a folder (kept between runs: ``--poses FOLDER``), solved as a user would, and compared with the
rig that rendered them. Depth bias: for camera pixels over the field and depths over the volume, the true projector
coordinate is triangulated with the solved rig; its depth is compared with the true one. Flatness: planes at places
that no reference had, decoded like in the conventional mode; the mean of their points over cells of a 24th of the
field, less their plane.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from endo3d.services.calibration.captured import Pose, of_folder
from endo3d.services.calibration.solving import Calibrated, solve
from endo3d.services.calibration.verifying import points
from endo3d.services.calibration.virtual import COLUMNS, VirtualCapture
from endo3d.services.cli.calibrate import DEFAULT_BOARD
from endo3d.services.cli.calibrate_capture import render
from endo3d.services.evaluation.virtual_run import head_yaml
from endo3d_core.calibrating.boards import Board
from endo3d_core.calibrating.bundle import NAMES, parameters_of
from endo3d_core.calibration import Rig
from endo3d_core.head import Head
from endo3d_core.metrology import fit_plane
from endo3d_core.triangulation import exact_depth
from endo3d_core.virtual_rig.effects import FULL

HEAD = "base6_wd20"
POSES, FLATS = 15, 3
FIELD_SHARE = 0.85
"""Of the fibre's radius: the field that counts."""
PLANES = ("plane z=18.2 tilt=-6,5", "plane z=20 tilt=8,-4", "plane z=21.8 tilt=3,7")
CELLS = 24
CELL_POINTS = 30
QUIET = FULL.without("projector_fibre", "camera_fibre", "noise", "quantisation")
"""Fibres off and noise low: what is left is the calibration itself."""


@dataclass(frozen=True, slots=True)
class Figure:
    what: str
    value: float
    goal: float
    unit: str

    @property
    def line(self) -> str:
        met = "met" if self.value <= self.goal else "MISSED"
        return f"| {self.what} | {self.value:.3g} {self.unit} | {self.goal:g} {self.unit} | {met} |"


def depth_errors_um(true: Rig, solved: Rig, head: Head) -> NDArray[np.float64]:
    """(depths, n) depth by the solved rig less the true one, over the volume."""
    line = np.linspace(-1, 1, 17)
    x, y = np.meshgrid(line, line)
    disc = np.hypot(x, y) <= 1
    middle = np.array(((true.camera.width - 1) / 2, (true.camera.height - 1) / 2))
    pixels = middle + FIELD_SHARE * head.camera_circle_px / 2 * np.stack((x[disc], y[disc]), axis=-1)
    rays = true.camera.ray(pixels)
    window = np.array(((true.projector.width - 1) / 2, (true.projector.height - 1) / 2))
    errors = []
    for z in np.linspace(head.z_min_mm, head.z_max_mm, 7):
        lit = true.projector_pixel(rays * z)
        inside = np.hypot(*(lit - window).T) <= head.projector_circle_px / 2
        error = 1e3 * (exact_depth(solved, pixels, lit[:, 0], float(z)) - z)
        errors.append(np.where(inside, error, np.nan))
    return np.stack(errors)


def cell_flatness_um(measured: NDArray[np.float64]) -> NDArray[np.float64]:
    """(cells,) mean distances from the plane of points (n, 3), of cells that are well filled."""
    distance = 1e3 * fit_plane(measured).distance(measured)
    edges = [np.linspace(measured[:, k].min(), measured[:, k].max() + 1e-9, CELLS + 1) for k in (0, 1)]
    index = [np.digitize(measured[:, k], edges[k]) - 1 for k in (0, 1)]
    cell = index[1] * CELLS + index[0]
    near = np.abs(distance) < 6 * 1.4826 * np.median(np.abs(distance))
    count = np.bincount(cell[near], minlength=CELLS * CELLS)
    total = np.bincount(cell[near], distance[near], minlength=CELLS * CELLS)
    filled = count >= max(CELL_POINTS, 0.5 * np.percentile(count[count > 0], 75))
    return np.asarray(total[filled] / count[filled])


def standardised(true: Rig, found: Calibrated) -> NDArray[np.float64]:
    """(parameters,) errors in stated standard deviations."""
    error = parameters_of(found.rig) - parameters_of(true)
    return np.array([error[NAMES.index(name)] / sigma for name, sigma in found.quality.sigma.items()])


def figures(true: Rig, head: Head, found: Calibrated, planes: list[Pose]) -> list[Figure]:
    """Beside the goals of the design."""
    error = depth_errors_um(true, found.rig, head)
    flatness = []
    for pose in planes:
        flatness.append(cell_flatness_um(points(found.rig, pose, (head.z_min_mm, head.z_max_mm))))
    cells = np.concatenate(flatness)
    return [
        Figure("reprojection, camera, rms", found.quality.reprojection_px[0], 0.1, "px"),
        Figure("reprojection, projector, rms", found.quality.reprojection_px[1], 0.1, "px"),
        Figure("depth bias over the volume, mean", abs(float(np.nanmean(error))), 2.0, "um"),
        Figure("depth bias over the volume, rms", float(np.sqrt(np.nanmean(error**2))), 2.0, "um"),
        Figure("depth bias over the volume, 95 %", float(np.nanpercentile(np.abs(error), 95)), 2.0, "um"),
        Figure("planes elsewhere, flatness of cells, rms", float(np.sqrt(np.mean(cells**2))), 2.0, "um"),
        Figure("planes elsewhere, flatness of cells, 95 %", float(np.percentile(np.abs(cells), 95)), 2.0, "um"),
        Figure("time to solve", found.seconds, 60.0, "s"),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--poses", type=Path, help="folder of rendered poses; rendered when it is not there")
    parser.add_argument("--head", default=HEAD)
    parser.add_argument("--board", default=DEFAULT_BOARD)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--sigma", action="store_true", help="the parameters against their stated sigma, fibres off")
    args = parser.parse_args()
    text = head_yaml(args.head)
    true, head, board = Rig.from_yaml(text), Head.from_yaml(text), Board.parse(args.board)
    if args.sigma:
        found = solve(VirtualCapture(text, board, POSES, 0, QUIET).captured())
        errors = standardised(true, found)
        rows = [Figure("parameters, largest error in stated sigma", float(np.abs(errors).max()), 3.0, "")]
    else:
        with tempfile.TemporaryDirectory() as scratch:
            folder = args.poses or Path(scratch) / "poses"
            if not folder.exists():
                render(folder, board, args.head, POSES, FLATS)
            found = solve(of_folder(folder))
        virtual = VirtualCapture(text, board)
        planes = [Pose(scene, virtual.side(scene, COLUMNS), virtual.side(scene, COLUMNS)) for scene in PLANES]
        rows = figures(true, head, found, planes)
    if args.json:
        print(json.dumps({"simulated": True, **{row.what: row.value for row in rows}}))
        return
    print(f"simulated: head {args.head}, {board.text}, {found.quality.poses} poses\n")
    print("| figure | value | goal | |\n|---|---|---|---|")
    print("\n".join(row.line for row in rows))
    for note in (found.quality.line, *found.notes):
        print(note)
    if args.sigma:
        for name, value in zip(found.quality.sigma, errors, strict=True):
            print(f"{name:14s} {value:+.2f}")


if __name__ == "__main__":
    main()
