"""The calibration's page: verdict, figures, every parameter with its standard deviation, and pictures."""

from __future__ import annotations

import html
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from endo3d.services.calibration.solving import Calibrated
from endo3d.services.views.figures import COLOURS, RAMPS, figure
from endo3d_core.bow import NO_BOW
from endo3d_core.calibrating.bundle import NAMES, parameters_of
from endo3d_core.calibrating.flat_reference import Flat, flatness_um

STYLE = (
    "body{font:15px/1.5 sans-serif;max-width:60em;margin:2em auto;padding:0 1em}"
    "table{border-collapse:collapse}td,th{border:1px solid #ccc;padding:.2em .6em;text-align:right}"
    "td:first-child,th:first-child{text-align:left}img{max-width:100%}"
    ".bad{color:#b3261e}.good{color:#1c7a3e}figure{margin:1.5em 0}figcaption{color:#555}"
)
ARROWS_PX = 200.0
"""Length of an arrow per pixel of error."""

Picture = tuple[str, str]
"""File name and caption."""


def write(found: Calibrated, out: Path, *, simulated: bool) -> Path:
    """``NAME.html``, ``NAME.json`` and the pictures in ``NAME_report`` beside the calibration; the page."""
    folder = out.with_name(f"{out.stem}_report")
    folder.mkdir(parents=True, exist_ok=True)
    pictures = [
        _errors(found, folder, simulated),
        _residuals(found, folder, simulated),
        _coverage(found, folder, simulated),
        _board(found, folder),
        *_flat(found, folder, simulated),
        *_response(found, folder, simulated),
        *_fibre(found, folder, simulated),
    ]
    page = out.with_suffix(".html")
    page.write_text(_page(found, out, folder.name, pictures, simulated), encoding="utf-8")
    facts: dict[str, Any] = {"simulated": simulated, "seconds": found.seconds, **asdict(found.quality)}
    facts |= {"pose_error_px": found.all_errors_px, "notes": found.notes}
    out.with_suffix(".json").write_text(json.dumps(facts, indent=1), encoding="utf-8")
    return page


def _page(found: Calibrated, out: Path, images: str, pictures: list[Picture], simulated: bool) -> str:
    e, q = html.escape, found.quality
    parts = [f"<h1>Calibration {e(out.stem)}</h1>"]
    parts += ["<p><b>simulated (virtual rig, no hardware)</b></p>"] if simulated else []
    parts += [f'<p class="{e(q.state)}"><b>{e(q.line)}</b></p>']
    rows = [
        ("poses used", str(q.poses)),
        ("reprojection error, camera / px", f"{q.reprojection_px[0]:.3f}"),
        ("reprojection error, projector / px", f"{q.reprojection_px[1]:.3f}"),
        ("largest standard deviation of depth / um", f"{q.depth_sigma_um:.2f}"),
        ("share of the field with features", f"{q.coverage:.0%}"),
    ]
    if q.flatness_um:
        rows += [("flat reference before / after the correction, rms / um",
                  f"{q.flatness_um[0]:.2f} / {q.flatness_um[1]:.2f}")]  # fmt: skip
    if found.response:
        rows += [
            ("gamma of the projector and camera", f"{found.response.gamma:.3f}"),
            ("response: violation before / after its removal",
             f"{found.response.residual_before:.4f} / {found.response.residual:.4f}"),
        ]  # fmt: skip
    if found.core_map:
        rows += [("fibre cores", f"{len(found.core_map.cores)}, {found.core_map.spacing_px:.2f} px apart")]
    rows += [("time to solve / s", f"{found.seconds:.1f}")]
    parts.append(_table(("figure", "value"), rows))
    parts += [f"<p>{e(note)}</p>" for note in found.notes]
    for name, caption in pictures:
        parts.append(f'<figure><img src="{e(images)}/{e(name)}" alt="{e(caption)}">'
                     f"<figcaption>{e(caption)}</figcaption></figure>")  # fmt: skip
    values = parameters_of(found.rig)
    parts.append("<h2>Parameters</h2>")
    parts.append(
        _table(
            ("parameter", "value", "standard deviation"),
            [
                (name, f"{values[i]:.6g}", f"{q.sigma[name]:.2g}" if name in q.sigma else "held")
                for i, name in enumerate(NAMES)
            ],
        )
    )
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>Calibration {e(out.stem)}</title>'
        f"<style>{STYLE}</style><body>{''.join(parts)}</body></html>\n"
    )


def _table(columns: tuple[str, ...], rows: list[Any]) -> str:
    head = "".join(f"<th>{html.escape(column)}</th>" for column in columns)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{body}</table>"


def _errors(found: Calibrated, folder: Path, simulated: bool) -> Picture:
    with figure("Error of each pose", simulated=simulated, path=folder / "poses.png", size_in=(8, 3)) as fig:
        axes = fig.subplots()
        names = list(found.all_errors_px)
        axes.bar(names, [found.all_errors_px[name] for name in names], color=COLOURS[0])
        axes.tick_params(axis="x", rotation=60)
        axes.set(ylabel="reprojection error, rms / px")
    return "poses.png", "Reprojection error of each pose that was used, camera and projector together."


def _residuals(found: Calibrated, folder: Path, simulated: bool) -> Picture:
    errors = np.concatenate(found.solution.residual_px)
    with figure("What the lenses' model leaves", simulated=simulated, path=folder / "residuals.png",
                size_in=(9, 4.2)) as fig:  # fmt: skip
        for axes, name, part, seen in zip(
            fig.subplots(1, 2), ("camera", "projector"), (errors[:, :2], errors[:, 2:]),
            ([s.camera_px for s in found.kept], [s.projector_px for s in found.kept]), strict=True,
        ):  # fmt: skip
            at = np.concatenate(seen)
            scale = {"angles": "xy", "scale_units": "xy", "scale": 1 / ARROWS_PX, "width": 2e-3}
            axes.quiver(*at.T, *part.T, color=COLOURS[0], **scale)
            axes.set(title=f"{name}, arrows {ARROWS_PX:g} x", xlabel="x / px", ylabel="y / px", aspect="equal")
            axes.invert_yaxis()
    return "residuals.png", "Residuals of all features: they should look random, without a common course."


def _coverage(found: Calibrated, folder: Path, simulated: bool) -> Picture:
    with figure("Coverage", simulated=simulated, path=folder / "coverage.png", size_in=(9, 4.2)) as fig:
        left, right = fig.subplots(1, 2)
        shown = left.imshow(np.where(found.cells < 0, np.nan, found.cells), cmap="viridis")
        fig.colorbar(shown, ax=left, label="features")
        left.set(title=f"camera's field: {found.quality.coverage:.0%} of the cells", xticks=[], yticks=[])
        left.grid(visible=False)
        poses = found.solution.poses
        tilt = np.degrees(np.linalg.norm(poses[:, :2], axis=1))
        right.plot(poses[:, 5], tilt, "o", color=COLOURS[1])
        right.set(title="poses of the board", xlabel="depth / mm", ylabel="tilt / deg")
    return "coverage.png", "Where features were seen, and from which depths and tilts."


def _board(found: Calibrated, folder: Path) -> Picture:
    image = cv2.cvtColor(found.picture, cv2.COLOR_GRAY2BGR)
    for u, v in found.kept[0].camera_px:
        cv2.drawMarker(image, (round(u), round(v)), (63, 102, 216), cv2.MARKER_CROSS, 21, 2)
    cv2.imwrite(str(folder / "board.png"), cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    return "board.png", f"{found.kept[0].name} without fringes and honeycomb, and the features that were used."


def _flat(found: Calibrated, folder: Path, simulated: bool) -> list[Picture]:
    if not found.flats:
        return []
    limit = max(float(np.percentile(np.abs(flatness_um(flat, NO_BOW)), 99)) for flat in found.flats)
    with figure("Flat reference", simulated=simulated, path=folder / "flat.png",
                size_in=(3.2 * len(found.flats) + 1, 5.4)) as fig:  # fmt: skip
        grid = fig.subplots(2, len(found.flats), squeeze=False)
        for row, (bow, what) in zip(grid, ((NO_BOW, "as solved"), (found.rig.bow, "corrected")), strict=True):
            for axes, flat in zip(row, found.flats, strict=True):
                error = flatness_um(flat, bow)
                shown = axes.scatter(flat.x, flat.y, c=error, s=5, cmap=RAMPS["deviation"], vmin=-limit, vmax=limit)
                axes.set(title=f"{_where(flat)}, {what}: {np.std(error):.2f} um", aspect="equal", xticks=[], yticks=[])
                axes.invert_yaxis()
        fig.colorbar(shown, ax=grid, label="depth over the plane / um", shrink=0.7)
    return [("flat.png", "Distances of the flat reference from its plane, before and after the correction of the bow.")]


def _where(flat: Flat) -> str:
    return f"{1.0 / float(np.median(flat.q)):.1f} mm"


def _response(found: Calibrated, folder: Path, simulated: bool) -> list[Picture]:
    if found.response is None:
        return []
    with figure("Response", simulated=simulated, path=folder / "response.png", size_in=(4.6, 3.6)) as fig:
        axes = fig.subplots()
        axes.plot(found.response.light, found.response.grey, color=COLOURS[0], label="measured")
        axes.plot((0, 1), (0, 1), "--", color=COLOURS[5], label="linear")
        axes.set(xlabel="light that was meant", ylabel="grey value, normalised")
        axes.set_title(f"gamma {found.response.gamma:.3f}")
        axes.legend()
    return [("response.png", "Response of projector and camera together, from the fringes on the flat reference.")]


def _fibre(found: Calibrated, folder: Path, simulated: bool) -> list[Picture]:
    core_map = found.core_map
    if core_map is None:
        return []
    v, u = (n // 2 for n in core_map.flat.shape)
    near = np.all(np.abs(core_map.cores - (u, v)) < 30, axis=1)
    with figure("Fibre", simulated=simulated, path=folder / "fibre.png", size_in=(9, 4.2)) as fig:
        left, right = fig.subplots(1, 2)
        middle = core_map.flat[v - 30 : v + 30, u - 30 : u + 30]
        left.imshow(middle, cmap="gray", extent=(u - 30.5, u + 29.5, v + 29.5, v - 30.5))
        left.plot(*core_map.cores[near].T, "+", color=COLOURS[1], ms=5)
        left.set(title="cores in the middle", xlabel="x / px", ylabel="y / px")
        blurred = cv2.GaussianBlur(core_map.flat, (0, 0), 3 * core_map.spacing_px)
        shown = right.imshow(blurred, cmap="viridis")
        fig.colorbar(shown, ax=right, label="grey value")
        right.set(title="flat field", xticks=[], yticks=[])
        for axes in (left, right):
            axes.grid(visible=False)
    return [("fibre.png", f"{len(core_map.cores)} cores of the imaging fibre, and how its field is lit.")]
