"""Section 4.2: the 1 mm cylinder of the contour standard on a linear stage, both modes (figs. 9 and 10)."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from endo3d.services.evaluation import figures_of_merit as merit
from endo3d.services.evaluation.cache import Cache, Result
from endo3d.services.evaluation.calibrated import calibrated
from endo3d.services.evaluation.measure import FIBRE, Merging, Settings, clouds, moved, points_of
from endo3d.services.evaluation.report import Report, Table
from endo3d.services.evaluation.virtual_run import VirtualRun, head_yaml
from endo3d.services.views.figures import COLOURS, figure
from endo3d_core.virtual_rig import contour_standard as standard
from endo3d_core.virtual_rig.effects import FULL

HEAD = "base6_wd20"
MODES = {"conventional": "conventional f=50/49/43 steps=6/2/2", "continuous": "interleaved f1=25"}
RATE_HZ = 132.0
FRAMES = 10
"""75.8 ms in either mode (table 3)."""
SPEEDS_MM_S = (0.0, 0.5, 2.0, 5.0, 10.0)
"""The paper's three, and two beyond."""
REPETITIONS = 25
MERGING_UM = 75.0
BIN_PX = 2
"""Of the camera: 960x600 pixels, still 1.7 per core of the fibre; the decoder's grid is the same."""
PAPER = {
    ("conventional", 0.0): ("-10 .. 10", "lower"),
    ("conventional", 0.5): ("-10 .. 20", "higher"),
    ("conventional", 2.0): ("no valid measurement", "-"),
    ("continuous", 0.0): ("-10 .. 10", "about 10"),
    ("continuous", 0.5): ("-10 .. 10", "about 10"),
    ("continuous", 2.0): ("-30 .. 20", "slightly higher"),
}
"""What section 4.2 says of figs. 9 and 10: size error / um, and form."""
SHARES: dict[str, tuple[str, ...]] = {
    "all effects": (),
    "without fibres": ("projector_fibre", "camera_fibre"),
    "without noise": ("noise", "quantisation"),
    "without motion": (),
    "with exact calibration": (),
    "with true poses": (),
}
SHARE_SPEED_MM_S = 2.0
SHARE_REPETITIONS = 5


def steps(quick: bool) -> int:
    """Measurements in all."""
    return len(_plan(quick)) + (0 if quick else (len(SHARES) - 1) * SHARE_REPETITIONS)


def _plan(quick: bool) -> list[tuple[str, float, int]]:
    speeds = (0.0, 2.0) if quick else SPEEDS_MM_S
    return [(mode, speed, k) for k in range(1 if quick else REPETITIONS) for speed in speeds for mode in MODES]


def evaluate(settings: Settings) -> Report:
    """Measure, or take what was measured before; tables, plots and figures."""
    folder, quick = settings.folder, settings.quick
    name = "cylinder-quick" if quick else "cylinder"
    cache = Cache(folder / f"{name}.cache.json")
    results: dict[tuple[str, float], list[Result]] = {}
    done = 0
    for mode, speed, k in _plan(quick):
        work = partial(_measure, settings, "all effects", mode, speed, k)
        result = cache.get(f"{mode} {speed} {k}", work)
        results.setdefault((mode, speed), []).append(result)
        done += 1
        settings.progress(done)
    shares: dict[str, list[Result]] = {}
    for variant in () if quick else SHARES:
        speed = 0.0 if variant == "without motion" else SHARE_SPEED_MM_S
        for k in range(SHARE_REPETITIONS):
            if variant == "all effects":
                result = results["continuous", SHARE_SPEED_MM_S][k]
            else:
                work = partial(_measure, settings, variant, "continuous", speed, k)
                result = cache.get(f"{variant} {k}", work)
                done += 1
                settings.progress(done)
            shares.setdefault(variant, []).append(result)
    return _report(folder, name, results, shares)


def _run(variant: str, mode: str, speed_mm_s: float, k: int) -> tuple[VirtualRun, float]:
    """One repetition, and where the cylinder's crest is: the standard is put down anew each time.

    The stage passes the middle at half time.
    """
    rng = np.random.default_rng((k, int(10 * speed_mm_s)))
    x_mm, y_mm = rng.uniform(-0.2, 0.2, 2)
    begin = -speed_mm_s * FRAMES / RATE_HZ / 2
    run = VirtualRun(
        head_yaml(HEAD),
        f"contour at={x_mm - standard.LARGE_CYLINDER_X_MM},{y_mm},20 surface=metal texture=noise:0.15:0.15",
        f"stage v={speed_mm_s} along=x start={begin},0,0" if speed_mm_s > 0.0 else "still",
        MODES[mode],
        RATE_HZ,
        FRAMES,
        seed=k,
        effects=FULL.without(*SHARES[variant]),
        bin_px=BIN_PX,
    )
    return run, float(x_mm)


def _measure(settings: Settings, variant: str, mode: str, speed_mm_s: float, k: int) -> Result:
    run, x_mm = _run(variant, mode, speed_mm_s, k)
    true = head_yaml(HEAD)
    known = true if variant == "with exact calibration" else calibrated(true)
    measured = list(clouds(settings, run, known))
    if not measured:
        return None
    if mode == "conventional":
        cloud, truth = measured[0]
        points = moved(truth.T_scene_camera, points_of(cloud))
    else:
        merging = Merging(MERGING_UM, true_poses=variant == "with true poses")
        for cloud, truth in measured:
            merging.add(cloud, truth)
        points = merging.map(at_least=2).points
    return merit.cylinder(points, x_mm, standard.RADIUS_LARGE_MM)


def _report(
    folder: Path, name: str, results: dict[tuple[str, float], list[Result]], shares: dict[str, list[Result]]
) -> Report:
    rows = []
    for (mode, speed), of in sorted(results.items()):
        valid = [r for r in of if r is not None]
        paper_size, paper_form = PAPER.get((mode, speed), ("not measured", "not measured"))
        size, form = (_range([r[key] for r in valid]) for key in ("size_um", "form_um"))
        count = f"{len(valid)} of {len(of)}"
        rows.append((mode, f"{speed:g}", paper_size, size, paper_form, form, count))
    columns = ("mode", "mm/s", "size, paper / um", "size / um", "form, paper / um", "form / um", "valid")
    tables = [Table("Cylinder of 0.9987 mm radius", columns, rows)]
    if shares:
        tables.append(_share_table(shares))
    _plot(folder / f"{name}.png", results)
    return Report(
        name,
        "Moving cylinder, both modes (paper: figs. 9 and 10)",
        [
            f"The contour standard (metal, 15 % texture) passes on a stage, {FRAMES} patterns at {RATE_HZ:g} Hz. "
            f"Head {HEAD}, camera binned to 960x600; conventional `{MODES['conventional']}`, continuous "
            f"`{MODES['continuous']}`, whose clouds are registered and merged at {MERGING_UM:g} um. "
            f"{len(next(iter(results.values())))} repetitions, each with the standard put down anew and its own noise. "
            "Slopes up to 60 degrees, 0.3 % of the points left out; a fit that is off by more than 0.1 mm counts as "
            f"no measurement. {FIBRE} Goal: continuous within +-10 um at 0 to 2 mm/s, valid at 10 mm/s.",
        ],
        tables,
        [f"{name}.png"],
        {
            "results": {f"{mode} {speed:g}": of for (mode, speed), of in results.items()},
            "shares": shares,
        },
    )


def _range(values: list[float]) -> str:
    return f"{min(values):.1f} .. {max(values):.1f}" if values else "no valid measurement"


def _share_table(shares: dict[str, list[Result]]) -> Table:
    rows = []
    for variant, of in shares.items():
        valid = [r for r in of if r is not None]
        if not valid:
            rows.append((variant, "no valid measurement", ""))
            continue
        size = np.sqrt(np.mean([r["size_um"] ** 2 for r in valid]))
        rows.append((variant, f"{size:.1f}", f"{np.mean([r['form_um'] for r in valid]):.1f}"))
    title = f"Shares of the error, continuous at {SHARE_SPEED_MM_S:g} mm/s, {SHARE_REPETITIONS} repetitions"
    return Table(title, ("", "size, rms / um", "form, mean / um"), rows)


def _plot(path: Path, results: dict[tuple[str, float], list[Result]]) -> None:
    """Figs. 9 (top) and 10 (bottom): conventional left, continuous right."""
    speeds = sorted({speed for _, speed in results})
    with figure("Moving cylinder", simulated=True, path=path, size_in=(8.5, 6)) as fig:
        axes = fig.subplots(2, 2, sharex=True, sharey="row")
        for column, mode in enumerate(MODES):
            for row, (key, label) in enumerate((("size_um", "size error / um"), ("form_um", "form, std / um"))):
                at = axes[row, column]
                for place, speed in enumerate(speeds):
                    values = [r[key] for r in results.get((mode, speed), []) if r is not None]
                    if values:
                        at.boxplot([values], positions=[place], widths=0.5)
                    else:
                        at.text(place, 0, "none valid", ha="center", fontsize=7, color=COLOURS[1])
                at.set(ylabel=label if column == 0 else "", title=f"fig. {9 + row}: {mode}")
                at.set_xticks(range(len(speeds)), [f"{speed:g}" for speed in speeds])
                at.set_xlabel("speed / mm/s" if row else "")
