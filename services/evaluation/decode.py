"""How exact the continuous mode decodes: still and moving, at edges and on texture, form by form."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d.services.evaluation.measure import Settings
from endo3d.services.evaluation.report import Report, Table
from endo3d.services.evaluation.virtual_run import head_yaml
from endo3d_core import metrology, patterns, triangulation
from endo3d_core.calibration import Rig
from endo3d_core.head import Head
from endo3d_core.interleaved import Form, Interleaved
from endo3d_core.virtual_rig import motion, scene, truth
from endo3d_core.virtual_rig.effects import FAST
from endo3d_core.virtual_rig.renderer import Renderer

HEAD, PATTERNS, FRAMES = "base6_wd20", "interleaved f1=25", 8
EXPOSURE_US = 15000.0
"""The brightest fringes reach two thirds of the range."""
PLANE = "plane tilt=10"
PIXEL_MM = 0.01
"""Of the 1920x1200 camera, at the working distance."""
CASES: tuple[tuple[str, str, tuple[float, float, float]], ...] = (
    ("plane, still", PLANE, (0.0, 0.0, 0.0)),
    *((f"plane, axial {um} um/frame", PLANE, (0.0, 0.0, um * 1e-3)) for um in (10, 20, 40, 80)),
    *(
        (f"texture, lateral {px} px/frame", PLANE + " texture=checker:0.5:1", (px * PIXEL_MM, 0.0, 0.0))
        for px in (1, 2, 4)
    ),
    ("texture, still", PLANE + " texture=checker:0.5:1", (0.0, 0.0, 0.0)),
    ("steps, still", "steps heights=0.05/0.1/0.2/0.5 width=1.5", (0.0, 0.0, 0.0)),
    ("step of 0.5 mm, still", "steps heights=0.5 width=2 at=-1,0,20", (0.0, 0.0, 0.0)),
    ("sphere R 1 mm, still", "sphere r=1 at=0,0,20.6", (0.0, 0.0, 0.0)),
)
VARIANTS: tuple[tuple[str, Form, bool], ...] = (
    ("reuse + fit", "reuse", True),
    ("reuse", "reuse", False),
    ("five", "five", False),
    ("three (published)", "three", False),
)
WRONG_ORDER_MM = 0.8
"""Half a fringe order in depth."""
SLOPE_MAX_DEG = 55.0
LEFT_OUT = 0.003
"""Share of the points that the standardised error leaves out, as VDI/VDE 2634 does."""
STEP_REACH = 14
"""Grid points on both sides of the step that its response is taken from."""


def steps(quick: bool) -> int:
    """Scenes in all."""
    return len(_cases(quick))


def _cases(quick: bool) -> tuple[tuple[str, str, tuple[float, float, float]], ...]:
    return tuple(case for case in CASES if not quick or "still" in case[0] or "axial 40" in case[0])


def evaluate(settings: Settings) -> Report:
    """Render, decode in every form, compare with the truth."""
    text = head_yaml(HEAD)
    rig, head = Rig.from_yaml(text), Head.from_yaml(text)
    lookup = triangulation.build(rig, 4, head.z_min_mm, head.z_max_mm)
    rows, figures = [], {}
    for done, (name, what, step_mm) in enumerate(_cases(settings.quick)):
        frames, poses = _render(rig, head, what, step_mm)
        for variant, form, fit in VARIANTS[: 2 if settings.quick else None]:
            decoder = Interleaved(patterns.parse(PATTERNS), lookup, 4, form=form, fit=fit)
            for k, frame in enumerate(frames):
                decoder.push(frame, k % 4)
            points = np.full((lookup.height, lookup.width, 6), np.nan, np.float32)
            if decoder.slots.trusted and decoder.count >= decoder.frames:
                decoder.points(points)
            known = truth.truth(rig, head, scene.parse(what, head.working_distance_mm), poses[-1 - decoder.latency], 4)
            true_depth = np.where(known.visible, known.depth_mm, np.nan)
            found = _compare(points, true_depth, "sphere" in name, poses[-1 - decoder.latency])
            if name.startswith("step of"):
                found["step_px"] = step_response_px(points[..., 2], true_depth)
            figures[f"{name}, {variant}"] = found
            rows.append((name, variant, *(f"{found[key]:.2f}" for key in _COLUMNS)))
        settings.progress(done + 1)
    return Report(
        "decode-quick" if settings.quick else "decode",
        "Decoding of the continuous mode",
        [
            f"Head {HEAD}, `{PATTERNS}`, 1920x1200 at 8 bit with noise, fibres and defocus off, 4x4 bins. "
            "Depth against the truth on the grid, um; coverage and wrong fringe orders in per cent of the visible "
            "field, the error without the wrong orders. Of the sphere the "
            f"slopes up to {SLOPE_MAX_DEG:g} degrees count, radius and form after a best fit. Error / sigma: standard "
            f"deviation of the errors over their sigmas, {100 * LEFT_OUT:g} % left out. Across the step the way from "
            "10 to 90 % of its height counts, gaps included."
        ],
        [Table("Depth error", ("case", "decoding", *_COLUMNS.values()), rows)],
        [],
        figures,
    )


_COLUMNS = {
    "coverage": "coverage %",
    "wrong": "wrong orders %",
    "rms_um": "rms um",
    "bias_um": "bias um",
    "error_sigma": "error / sigma",
    "radius_um": "radius um",
    "form_um": "form um",
    "step_px": "10-90 % px",
}


def _render(
    rig: Rig, head: Head, what: str, step_mm: tuple[float, float, float]
) -> tuple[list[NDArray[np.uint8]], list[NDArray[np.float64]]]:
    renderer = Renderer(rig, head, scene.parse(what, head.working_distance_mm), FAST)
    window = rig.projector
    lights = [renderer.light(patterns.image(p, window.width, window.height)) for p in patterns.parse(PATTERNS).patterns]
    frames, poses = [], []
    for k in range(FRAMES):
        pose = motion.transform(np.array(step_mm) * (FRAMES / 2 - k))
        frame = np.empty((rig.camera.height, rig.camera.width), np.uint8)
        renderer.frame(lights[k % len(lights)], [pose], EXPOSURE_US, k, frame)
        frames.append(frame)
        poses.append(pose)
    return frames, poses


def _compare(
    points: NDArray[np.float32], depth_mm: NDArray[np.float64], sphere: bool, T_scene_camera: NDArray[np.float64]
) -> dict[str, Any]:
    visible = np.isfinite(depth_mm)
    error = points[..., 2] - depth_mm
    radius_um = form_um = float("nan")
    if sphere:
        centre = np.array((0.0, 0.0, 20.6)) - T_scene_camera[:3, 3]
        normal = points[..., :3] - centre
        view = -points[..., :3] / np.linalg.norm(points[..., :3], axis=-1, keepdims=True)
        cosine = np.sum(normal * view, axis=-1) / np.linalg.norm(normal, axis=-1)
        chosen = visible & (cosine > np.cos(np.deg2rad(SLOPE_MAX_DEG)))
        fitted = metrology.fit_sphere(points[chosen][:, :3].astype(np.float64))
        radius_um, form_um = 1e3 * (fitted.radius_mm - 1.0), fitted.form_um
        error = np.where(chosen, error, np.nan)
        visible = chosen
    standardised = (error / points[..., 5])[visible & np.isfinite(error)]
    middle = np.abs(standardised) <= np.quantile(np.abs(standardised), 1.0 - LEFT_OUT) if standardised.size else []
    known = error[visible & np.isfinite(error)]
    wrong = np.abs(known) > WRONG_ORDER_MM
    right = known[~wrong] if (~wrong).any() else np.array([np.nan])
    return {
        "coverage": float("nan") if sphere else 100.0 * known.size / max(1, int(visible.sum())),
        "wrong": 100.0 * float(wrong.mean()) if known.size else float("nan"),
        "rms_um": 1e3 * float(np.sqrt(np.mean(right**2))),
        "bias_um": 1e3 * float(np.mean(right)),
        "error_sigma": float(np.std(standardised[middle])) if standardised.size else float("nan"),
        "radius_um": radius_um,
        "form_um": form_um,
        "step_px": float("nan"),
    }


def step_response_px(depth: NDArray[np.float32], true_depth: NDArray[np.float64]) -> float:
    """Grid points from 10 to 90 % of a step across the columns, median over the middle rows; gaps count."""
    rows = slice(depth.shape[0] // 2 - 50, depth.shape[0] // 2 + 50)
    reaches = []
    for z, expected in zip(depth[rows], true_depth[rows], strict=True):
        jump = int(np.nanargmax(np.abs(np.diff(_filled(expected)))))
        around = z[jump - STEP_REACH : jump + STEP_REACH].astype(np.float64)
        left, right = np.nanmedian(around[:5]), np.nanmedian(around[-5:])
        at = np.flatnonzero(np.isfinite(around))
        level = (around[at] - left) / (right - left)
        high = int(np.argmax(level > 0.5))
        begin = high - 1 - int(np.argmax(level[high - 1 :: -1] < 0.1))
        end = high + int(np.argmax(level[high:] > 0.9))
        first = np.interp(0.1, level[begin : begin + 2], at[begin : begin + 2])
        last = np.interp(0.9, level[end - 1 : end + 1], at[end - 1 : end + 1])
        reaches.append(last - first)
    return float(np.median(reaches))


def _filled(row: NDArray[np.float64]) -> NDArray[np.float64]:
    """Gaps take the value before them."""
    known = np.maximum.accumulate(np.where(np.isfinite(row), np.arange(row.size), 0))
    return np.nan_to_num(row[known], nan=float(np.nanmean(row)))
