"""Section 4.2, second part: the contour standard scanned by hand for 26 s (table 5, fig. 11)."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from endo3d.services.evaluation import figures_of_merit as merit
from endo3d.services.evaluation.cache import Cache, Result
from endo3d.services.evaluation.calibrated import calibrated
from endo3d.services.evaluation.measure import FIBRE, Clouds, Map, Merging, Points, Settings
from endo3d.services.evaluation.report import Report, Table
from endo3d.services.evaluation.virtual_run import VirtualRun, head_yaml
from endo3d.services.views.figures import COLOURS, RAMPS, figure
from endo3d_core import metrology
from endo3d_core.virtual_rig import contour_standard as standard
from endo3d_core.virtual_rig.effects import FULL
from endo3d_core.virtual_rig.scene import parse
from endo3d_core.virtual_rig.truth import distance

HEAD = "base6_wd20"
SCENE = "contour surface=metal texture=noise:0.15:0.15"
MOTION = "hand seed=7 reach=5 speed=3"
PATTERNS = "interleaved f1=15"
RATE_HZ = 172.0
DURATION_S = 26.0
SHARE_FIRST, SHARE_FRAMES = 740, 688
"""The shares are of these 4 s of the scan: from its middle to one end and back, all features in view."""
QUICK_S = 0.5
MERGING_UM = 75.0
BIN_PX = 2
"""Of the camera: 960x600 pixels."""
AT_LEAST = 10
"""Observations of a map point that counts."""
BASE_Z_MM = 20.0
VARIANTS: dict[str, tuple[str, ...]] = {
    "all effects": (),
    "without fibres": ("projector_fibre", "camera_fibre"),
    "without noise": ("noise", "quantisation"),
    "without motion blur": ("motion_blur",),
    "with exact calibration": (),
    "with true poses": (),
}
PAPER: dict[str, tuple[float, float, float, str]] = {
    "radius, small": (1e3 * standard.RADIUS_SMALL_MM, 476.3, 10.9, "um"),
    "radius, large": (1e3 * standard.RADIUS_LARGE_MM, 1027.0, 12.8, "um"),
    "angle": (standard.ANGLE_DEG, 87.4, 7.2, "deg"),
    "step, large": (1e3 * standard.STEP_LARGE_MM, 995.3, 7.2, "um"),
    "step, small": (1e3 * standard.STEP_SMALL_MM, 480.0, 8.0, "um"),
}
"""Table 5: reference, measured, form deviation / um."""


RENDERED = ("without fibres", "without noise", "without motion blur")
"""The variants that need frames of their own; the others share those of the whole scan."""


def steps(quick: bool) -> int:
    """Frames in all."""
    return round(RATE_HZ * QUICK_S) if quick else round(RATE_HZ * DURATION_S) + len(RENDERED) * SHARE_FRAMES


def evaluate(settings: Settings) -> Report:
    """Measure, or take what was measured before; tables, plots and figures."""
    name = "handheld-quick" if settings.quick else "handheld"
    cache = Cache(settings.folder / f"{name}.cache.json")
    seconds = QUICK_S if settings.quick else DURATION_S
    kept = settings.folder / f"{name}.map.npz"
    result = cache.get("scan", partial(_scan, settings, seconds, kept)) or {}
    shares: dict[str, Result] = {}
    if not settings.quick:
        shares |= result["shares"]
        for k, variant in enumerate(RENDERED):
            before = round(RATE_HZ * DURATION_S) + k * SHARE_FRAMES
            shares[variant] = cache.get(variant, partial(_variant, settings, variant, before))
        shares = {variant: shares[variant] for variant in VARIANTS}
    return _report(settings.folder, name, seconds, result, shares, kept)


def _run(variant: str, frames: int, first: int = 0) -> VirtualRun:
    return VirtualRun(
        head_yaml(HEAD),
        SCENE,
        MOTION,
        PATTERNS,
        RATE_HZ,
        frames,
        effects=FULL.without(*VARIANTS[variant]),
        bin_px=BIN_PX,
        begin_s=first / RATE_HZ,
    )


def _scan(settings: Settings, seconds: float, kept: Path) -> Result:
    """The whole scan; beside it a part of it anew, also with exact calibration and with true poses."""
    run, true = _run("all effects", round(RATE_HZ * seconds)), head_yaml(HEAD)
    decoding, exact = Clouds(settings, run, calibrated(true)), Clouds(settings, run, true)
    hand, part, placed, exact_part = (Merging(MERGING_UM, true_poses=k == 2) for k in range(4))
    for frame, truth in settings.shots(run):
        in_part = SHARE_FIRST <= frame.sequence < SHARE_FIRST + SHARE_FRAMES
        for cloud, where in decoding.of(frame, truth):
            hand.add(cloud, where)
            if in_part:
                part.add(cloud, where)
                placed.add(cloud, where)
        if in_part:
            for cloud, where in exact.of(frame, truth):
                exact_part.add(cloud, where)
        settings.progress(frame.sequence + 1)
    found = hand.map(AT_LEAST)
    np.savez(kept, points=found.points.astype(np.float32), path=found.estimated[:, :3, 3])
    if settings.quick:
        return _outcome(hand)
    shares = {
        "all effects": _outcome(part),
        "with exact calibration": _outcome(exact_part),
        "with true poses": _outcome(placed),
    }
    return {**_outcome(hand), "shares": shares}


def _variant(settings: Settings, variant: str, before: int) -> Result:
    """That part with frames that lack an effect; None when nothing of it was tracked."""
    run = _run(variant, SHARE_FRAMES, SHARE_FIRST)
    decoding, hand = Clouds(settings, run, calibrated(head_yaml(HEAD))), Merging(MERGING_UM)
    for done, (frame, truth) in enumerate(settings.shots(run), start=1):
        for cloud, where in decoding.of(frame, truth):
            hand.add(cloud, where)
        settings.progress(before + done)
    return _outcome(hand) if len(hand.map(AT_LEAST).points) else None


def _outcome(merging: Merging) -> dict[str, Any]:
    found = merging.map(AT_LEAST)
    return {"features": features(found.points), "odometry": _odometry(found)}


def _odometry(found: Map) -> dict[str, Any]:
    """Trajectory and surface against the truth."""
    off_um = 1e3 * (found.estimated[:, :3, 3] - found.true[:, :3, 3])
    surface = metrology.surface_error(found.points, lambda p: distance(parse(SCENE, BASE_Z_MM), p))
    return {
        "ate_um": float(np.sqrt(np.mean(np.sum(off_um**2, axis=1)))),
        "end_um": [float(v) for v in off_um[-1]],
        "states": found.states,
        "surface_std_um": surface.std_um,
        "surface_p95_um": surface.p95_um,
        "map_points": surface.count,
    }


def features(points: Points) -> dict[str, Result]:
    """The five features of table 5 from points in the scene's axes: value and form, None where not seen."""
    x = points[:, 0]

    def between(a: float, b: float) -> Points:
        return points[(x > a) & (x < b)]

    found: dict[str, Result] = {}
    for name, at, radius in (
        ("radius, small", standard.SMALL_CYLINDER_X_MM, standard.RADIUS_SMALL_MM),
        ("radius, large", standard.LARGE_CYLINDER_X_MM, standard.RADIUS_LARGE_MM),
    ):
        fit = merit.cylinder(points, at, radius)
        found[name] = fit and {"value": 1e3 * radius + fit["size_um"], "form_um": fit["form_um"]}
    wedge, step = standard.WEDGE_X_MM, standard.LARGE_STEP_X_MM
    left, right = between(wedge - 0.85, wedge - 0.2), between(wedge + 0.2, wedge + 1.3)
    found["angle"] = None
    if min(len(left), len(right)) > merit.LEAST_POINTS:
        flanks = metrology.fit_plane(left), metrology.fit_plane(right)
        inside = np.array((wedge, float(np.median(points[:, 1])), BASE_Z_MM))
        distances = np.concatenate((flanks[0].distance(left), flanks[1].distance(right)))
        angle = metrology.wedge_angle_deg(*flanks, inside)
        found["angle"] = {"value": angle, "form_um": merit.form_um(distances)}
    top = between(step + 0.4, standard.SMALL_STEP_X_MM - 0.4)
    for name, lower in (
        ("step, large", between(step - 1.0, step - 0.4)),
        ("step, small", between(standard.SMALL_STEP_X_MM + 0.4, standard.SMALL_STEP_X_MM + 2.0)),
    ):
        found[name] = None
        if min(len(lower), len(top)) > merit.LEAST_POINTS:
            base = metrology.fit_plane(lower)
            height, _ = metrology.step_height_mm(base, top)
            above = base.distance(top)
            form = merit.form_um(np.concatenate((base.distance(lower), above - np.median(above))))
            found[name] = {"value": 1e3 * height, "form_um": form}
    return found


def _report(
    folder: Path, name: str, seconds: float, result: dict[str, Any], shares: dict[str, Result], scan: Path
) -> Report:
    rows = []
    for feature, (reference, paper, paper_form, unit) in PAPER.items():
        digits = 2 if unit == "deg" else 1
        ours = result["features"][feature]
        theirs = (f"{paper:.{digits}f} ({paper - reference:+.{digits}f})", f"{paper_form:.1f}")
        mine = ("not seen", "")
        if ours is not None:
            mine = (
                f"{ours['value']:.{digits}f} ({ours['value'] - reference:+.{digits}f})",
                f"{ours['form_um']:.1f}",
            )
        goal = f"{abs(paper - reference) / 3:.{digits}f}"
        rows.append((f"{feature} / {unit}", f"{reference:.{digits}f}", *theirs, *mine, goal))
    columns = ("feature", "reference", "paper", "form / um", "ours", "form / um", "goal: error below")
    tables = [Table(f"Table 5, {seconds:g} s by hand", columns, rows)]
    o = result["odometry"]
    states = ", ".join(f"{state} {count}" for state, count in o["states"].items())
    tables.append(
        Table(
            "Against the known truth (the paper had none)",
            ("figure", "ours"),
            [
                ("trajectory error, rms / um", f"{o['ate_um']:.1f}"),
                ("at the end, x y z / um", ", ".join(f"{v:.1f}" for v in o["end_um"])),
                ("surface error, std / um", f"{o['surface_std_um']:.1f}"),
                ("surface error, 95 % below / um", f"{o['surface_p95_um']:.1f}"),
                ("clouds", states),
                ("map points", f"{o['map_points']}"),
            ],
        )
    )
    if shares:
        tables.append(_share_table(shares))
    _plot(folder / f"{name}.png", scan)
    whole = f"Only {seconds:g} s of the paper's {DURATION_S:g} s were run. " if seconds < DURATION_S else ""
    part = (
        f"The shares are of {SHARE_FRAMES / RATE_HZ:.0f} s of it, begun anew: from the middle to one end and back."
        if shares
        else ""
    )
    return Report(
        name,
        "Scan by hand (paper: table 5 and fig. 11)",
        [
            f"`{SCENE}` scanned along its profile, motion `{MOTION}` (seeded: drift of about 3 mm/s, tremor of "
            f"50 to 100 um at 8 to 12 Hz), {RATE_HZ:g} Hz, `{PATTERNS}`, head {HEAD}, camera binned to 960x600, "
            f"merging distance {MERGING_UM:g} um, map points with {AT_LEAST} observations or more. "
            f"{FIBRE} {whole}{part}",
        ],
        tables,
        [f"{name}.png"],
        {"scan": result, "shares": shares},
    )


def _share_table(shares: dict[str, Result]) -> Table:
    """Deviation of every feature with single effects switched off."""
    rows = []
    for variant, result in shares.items():
        cells = []
        for feature, (reference, _, _, unit) in PAPER.items():
            ours = (result or {"features": {}})["features"].get(feature)
            cells.append("not seen" if ours is None else f"{ours['value'] - reference:+.{2 if unit == 'deg' else 1}f}")
        rows.append((variant, *cells, f"{result['odometry']['ate_um']:.1f}" if result else "lost"))
    columns = ("deviation", *(f"{feature} / {PAPER[feature][3]}" for feature in PAPER), "trajectory / um")
    return Table(f"Shares of the error, {SHARE_FRAMES / RATE_HZ:.0f} s", columns, rows)


def _plot(path: Path, scan: Path) -> None:
    """Fig. 11: the merged points above, the path of the head below."""
    kept = np.load(scan)
    points, track = kept["points"], kept["path"]
    with figure("Merged scan and path of the head", simulated=True, path=path, size_in=(8.5, 5)) as fig:
        above, below = fig.subplots(2, 1, height_ratios=(2, 1), sharex=True)
        some = points[np.random.default_rng(0).permutation(len(points))[:60_000]]
        above.scatter(some[:, 0], BASE_Z_MM - some[:, 2] + 0.3 * some[:, 1], s=0.3, c=some[:, 2], cmap=RAMPS["height"])
        above.set(ylabel="height + 0.3 y / mm", title="map", aspect="equal")
        below.plot(track[:, 0], track[:, 1], color=COLOURS[0], lw=0.7)
        below.set(xlabel="x / mm", ylabel="y / mm", title="path of the sensor head")
