"""Section 4.1: a sphere of 1 mm at 27 places, conventional mode, three exposures (figs. 6 to 8)."""

from __future__ import annotations

import itertools
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d.services.evaluation import figures_of_merit as merit
from endo3d.services.evaluation.cache import Cache, Result
from endo3d.services.evaluation.calibrated import calibrated
from endo3d.services.evaluation.measure import FIBRE, Settings, clouds, points_of
from endo3d.services.evaluation.report import Report, Table
from endo3d.services.evaluation.virtual_run import VirtualRun, head_yaml
from endo3d.services.views.figures import COLOURS, figure
from endo3d_core.head import Head
from endo3d_core.virtual_rig.defocus import focus_mm
from endo3d_core.virtual_rig.effects import FULL, Effects

HEAD = "base6_wd10"
RADIUS_MM = 1.0
PATTERNS = "conventional f=50/49/43 steps=4/2/2 exposures_us=10200/40800/163200"
SPAN_MM = (4.5, 4.5, 2.0)
"""Of the sphere's centres: width, height, depth."""
BEHIND_FOCUS_MM = 0.5
"""The centres' middle lies so far behind the focus that the faces of the spheres lie about it."""
VARIANTS: dict[str, tuple[str, ...]] = {
    "all effects": (),
    "without fibres": ("projector_fibre", "camera_fibre"),
    "without noise": ("noise", "quantisation"),
    "without defocus": ("projector_defocus", "camera_defocus"),
    "with exact calibration": (),
}


def evaluate(settings: Settings) -> Report:
    """Measure, or take what was measured before; tables, plots and figures."""
    folder, quick = settings.folder, settings.quick
    cache = Cache(folder / f"spheres{'-quick' if quick else ''}.cache.json")
    places = _places(3)
    if quick:
        places = [place for place in places if place in ((0, 0, 0), (1, 0, 0), (0, -1, 1))]
    shares = [place for place in places if place[2] == 0]
    results: dict[str, dict[tuple[int, ...], Result]] = {}
    done = 0
    for variant in _variants(quick):
        results[variant] = {}
        for place in places if variant == "all effects" else shares:
            work = partial(_measure, settings, variant, place)
            results[variant][place] = cache.get(f"{variant} {place}", work)
            done += 1
            settings.progress(done)
    return _report(folder, results, quick)


def steps(quick: bool) -> int:
    """Measurements in all."""
    return (3 if quick else 27) + (len(_variants(quick)) - 1) * (2 if quick else 9)


def _variants(quick: bool) -> list[str]:
    return list(VARIANTS)[: 2 if quick else None]


def _places(count: int) -> list[tuple[int, ...]]:
    reach = range(-(count // 2), count // 2 + 1)
    return list(itertools.product(reach, reach, reach))


def _centre(place: tuple[int, ...]) -> NDArray[np.float64]:
    middle = np.array((0.0, 0.0, focus_mm(Head.from_yaml(head_yaml(HEAD))) + BEHIND_FOCUS_MM))
    return np.asarray(middle + np.array(place) * np.array(SPAN_MM) / 2, np.float64)


def _measure(settings: Settings, variant: str, place: tuple[int, ...]) -> Result:
    true = head_yaml(HEAD)
    effects: Effects = FULL.without(*VARIANTS[variant])
    x, y, z = _centre(place)
    run = VirtualRun(
        true, f"sphere r={RADIUS_MM} at={x},{y},{z} surface=metal", "still", PATTERNS, rate_hz=90.0, frames=24,
        seed=_places(3).index(place), effects=effects, bin_px=2 if settings.quick else 1,
    )  # fmt: skip
    known = true if variant == "with exact calibration" else calibrated(true)
    for cloud, _ in clouds(settings, run, known):
        return merit.sphere(points_of(cloud), np.array((x, y, z)), RADIUS_MM)
    return None


def _report(folder: Path, results: dict[str, dict[tuple[int, ...], Result]], quick: bool) -> Report:
    base = {place: r for place, r in results["all effects"].items() if r is not None}
    size = np.array([r["size_um"] for r in base.values()])
    form = np.array([r["form_um"] for r in base.values()])
    centre = [r["form_um"] for place, r in base.items() if place[:2] == (0, 0)]
    distance, relative = _distances({place: r["centre"] for place, r in base.items()})
    worst = float(np.abs(relative).max()) if len(relative) else np.nan
    valid = f"{len(base)} of {len(results['all effects'])}"
    rows = [
        ("size error / um", "-10 .. 16", f"{size.min():.1f} .. {size.max():.1f}", "-5 .. 5"),
        ("form, centre / um", "< 2.5", f"{max(centre):.1f}", "2"),
        ("form, everywhere / um", "< 4.0", f"{form.max():.1f}", "3"),
        ("distance error / %", "< 2", f"{worst:.2f}", "0.3"),
        ("places measured", "27 of 27", valid, "27 of 27"),
    ]
    name = "spheres-quick" if quick else "spheres"
    _plot(folder / f"{name}.png", base, distance, relative)
    return Report(
        name,
        "Spheres, conventional mode (paper: figs. 6 to 8)",
        [
            f"A sphere of {RADIUS_MM:g} mm with a metal surface stands at {len(results['all effects'])} places in "
            f"{SPAN_MM[0]:g} x {SPAN_MM[1]:g} x {SPAN_MM[2]:g} mm (centres). Head {HEAD}, `{PATTERNS}`. "
            "Evaluated after VDI/VDE 2634 part 2 on slopes up to 60 degrees, 0.3 % of the points left out. "
            "Each is decoded with a calibration solved from 15 simulated board poses with 0.1 px of corner noise. "
            f"At the corners of the volume the round field shows only a part of the sphere. {FIBRE}",
        ],
        [
            Table("Spheres", ("figure", "paper", "ours", "goal"), rows),
            _shares(results),
        ],
        [f"{name}.png"],
        {
            "places": {str(place): result for place, result in results["all effects"].items()},
            "distance_mm": [float(v) for v in distance],
            "distance_error_percent": [float(v) for v in relative],
        },
    )


def _distances(centres: dict[tuple[int, ...], list[float]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """True distance between each two places, mm, and the relative error of the measured one, %."""
    pairs = list(itertools.combinations(centres, 2))
    true = np.array([np.linalg.norm(_centre(a) - _centre(b)) for a, b in pairs])
    ours = np.array([np.linalg.norm(np.subtract(centres[a], centres[b])) for a, b in pairs])
    return true, 100.0 * (ours - true) / true if len(pairs) else true


def _shares(results: dict[str, dict[tuple[int, ...], Result]]) -> Table:
    """Size and form with single effects switched off, at the places that every variant measured."""
    common = [p for p in results["without fibres"] if all(of.get(p) is not None for of in results.values())]
    rows = []
    for variant, of in results.items():
        measured = [r for p in common if (r := of[p]) is not None]
        if not measured:
            rows.append((variant, "not measured", "not measured"))
            continue
        size = np.sqrt(np.mean([r["size_um"] ** 2 for r in measured]))
        rows.append((variant, f"{size:.1f}", f"{np.mean([r['form_um'] for r in measured]):.1f}"))
    return Table(
        f"Shares of the error, {len(common)} places in the middle plane",
        ("", "size, rms / um", "form, mean / um"),
        rows,
    )


def _plot(
    path: Path,
    base: dict[tuple[int, ...], dict[str, Any]],
    distance: NDArray[np.float64],
    relative: NDArray[np.float64],
) -> None:
    """Figs. 6, 7 and 8 side by side."""
    with figure("Spheres at 27 places", simulated=True, path=path, size_in=(11, 3.6)) as fig:
        axes = fig.subplots(1, 3)
        for level in (-1, 0, 1):
            of = [(np.hypot(*_centre(p)[:2]), r) for p, r in base.items() if p[2] == level]
            label, colour = f"z {level:+d} mm", COLOURS[level + 1]
            radius = [rho for rho, _ in of]
            axes[0].plot(radius, [r["size_um"] for _, r in of], "o", color=colour, label=label, ms=4)
            axes[1].plot(radius, [r["form_um"] for _, r in of], "o", color=colour, label=label, ms=4)
        axes[0].set(xlabel="distance from the axis / mm", ylabel="size error / um", title="fig. 6: size")
        axes[1].set(
            xlabel="distance from the axis / mm",
            ylabel="form, std / um",
            title="fig. 7: form",
            ylim=(0, None),
        )
        axes[2].plot(distance, relative, ".", color=COLOURS[0])
        axes[2].set(xlabel="distance of the centres / mm", ylabel="distance error / %", title="fig. 8: distance")
        axes[0].legend(fontsize=7)
