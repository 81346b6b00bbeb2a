"""Odometry against the truth: simulated clouds, and, separately, clouds decoded from rendered frames."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d.services.evaluation import handheld
from endo3d.services.evaluation.cache import Cache
from endo3d.services.evaluation.measure import Settings, clouds
from endo3d.services.evaluation.odometry_scans import (
    Outcome,
    Round,
    TrueCloud,
    halved,
    occluded,
    relief_mesh,
    simulated,
    track,
)
from endo3d.services.evaluation.report import Report, Table
from endo3d.services.evaluation.virtual_run import VirtualRun, head_yaml
from endo3d.services.views.figures import COLOURS, figure
from endo3d_core import backends, rigid
from endo3d_core import simulated_clouds as sim
from endo3d_core.loop_closure import LoopClosing
from endo3d_core.odometry import State
from endo3d_core.part_registration import Fit, Part, PartRegistration, visible_points
from endo3d_core.registration import visible_surface
from endo3d_core.virtual_rig.effects import FULL
from endo3d_core.virtual_rig.scene import parse
from endo3d_core.virtual_rig.truth import distance

LONG = sim.HandMotion(reach_mm=(4.0, 1.0), centre_mm=(1.0, 0.0))
"""Along the whole contour standard and back."""
RENDERED = "contour texture=noise:0.15:0.15"
LOOK_EVERY = 8
T_PART_SCENE = rigid.exp([30.0, 5.0, -7.0, 0.4, 1.2, -0.3])
"""Where the CAD model's axes lie: anywhere."""
SMALL = sim.Sensor(width=240, height=160)
"""Of the quick version."""
CASES = ("contour", "blade", "ball", "plane", "bare", "halved", "occluded", "round", "part", "rendered")


def steps(quick: bool) -> int:
    """Scans in all."""
    return len(CASES)


def evaluate(settings: Settings) -> Report:
    """Run what was not run before; tables, plots and figures."""
    name = "odometry-quick" if settings.quick else "odometry"
    cache, found = Cache(settings.folder / f"{name}.cache.json"), {}
    for done, case in enumerate(CASES):
        found[case] = cache.get(case, lambda case=case: _run(settings, case))  # type: ignore[misc]
        settings.progress(done + 1)
    return _report(settings.folder, name, settings.quick, found)


def _run(settings: Settings, case: str) -> dict[str, Any]:
    quick = settings.quick
    sensor = SMALL if quick else sim.Sensor()
    match case:
        case "contour":
            done = track(*_clouds("contour", LONG, 1.0 if quick else 26.0, sensor), backends.make())
            return {**done.figures(), "features": _features(done, quick), **_plotted(done)}
        case "blade" | "ball" | "plane":
            return track(*_clouds(case, sim.HandMotion(), 0.5 if quick else 5.0, sensor), backends.make()).figures()
        case "bare":
            bare = sim.Sensor(sensor.width, sensor.height, texture=0.0)
            done = track(*_clouds("contour", LONG, 0.5 if quick else 5.0, bare), backends.make())
            rms = np.sqrt((done.off_um() ** 2).mean(axis=0))
            share = done.states.count(State.DEGENERATE) / len(done.states)
            return {**done.figures(), "axes_um": rms.tolist(), "degenerate": share}
        case "halved":
            given, surface = _clouds("contour", sim.HandMotion(), 0.5 if quick else 2.0, sensor)
            return track(halved(given), surface, backends.make()).figures()
        case "occluded":
            given, surface = _clouds("contour", sim.HandMotion(), 0.8 if quick else 2.0, sensor)
            seconds = (0.3, 0.6) if quick else (1.0, 1.3)
            done = track(occluded(given, *seconds), surface, backends.make())
            return {**done.figures(), "found_after": _found_after(done)}
        case "round":
            return _round(quick, sensor)
        case "part":
            return _part(quick, sensor)
        case _:
            return _rendered(settings)


def _clouds(scene: str, motion: Any, duration_s: float, sensor: sim.Sensor) -> tuple[Any, Any]:
    surface = sim.SCENES[scene]()
    return simulated(surface, motion, duration_s, sensor), surface.distance


def _features(done: Outcome, quick: bool) -> dict[str, Any]:
    """The standard's features, as ``bench.odometry`` reads them; none in the quick version."""
    points = done.points()
    x, h = points[:, 0], -points[:, 2]
    if quick:
        return {}
    from endo3d_core import metrology

    def flat(low: float, high: float, height: float) -> NDArray[np.float64]:
        return points[(x > low) & (x < high) & (np.abs(h - height) < 0.1)]

    out = {}
    for radius, centre in ((1.0, -3.5), (0.5, -1.0)):
        angle = np.degrees(np.arctan2(x - centre, h))
        cap = points[(np.hypot(x - centre, h) < 1.3 * radius) & (h > 0.2) & (np.abs(angle) < 50)]
        out[f"radius {radius} / um"] = 1e3 * (metrology.fit_cylinder(cap, axis=(0, 1, 0)).radius_mm - radius)
    base, top = metrology.fit_plane(flat(-2.3, -1.7, 0.0)), metrology.fit_plane(flat(0.9, 1.7, 1.0))
    for step, lower, upper in ((1.0, base, flat(0.9, 1.7, 1.0)), (0.5, top, flat(2.4, 3.2, 0.5))):
        out[f"step {step} / um"] = 1e3 * (metrology.step_height_mm(lower, upper)[0] - step)
    left, right = (metrology.fit_plane(points[(np.abs(x - at) < 0.25) & (h > 0.2)]) for at in (5.05, 5.95))
    out["angle 90 / deg"] = metrology.wedge_angle_deg(left, right, inside=(5.5, 0.0, 0.0)) - 90.0
    return out


def _plotted(done: Outcome, at_most: int = 2000) -> dict[str, Any]:
    """Errors over the clouds, thinned for the plot."""
    off = done.off_um()[:: max(len(done.poses) // at_most, 1)]
    return {"off_um": np.round(off, 3).tolist()}


def _found_after(done: Outcome) -> int | None:
    """Clouds from the end of the occlusion to the relocalisation."""
    last_lost = max((k for k, state in enumerate(done.states) if state is State.LOST), default=None)
    if last_lost is None or State.RELOCALISED not in done.states:
        return None
    return done.states.index(State.RELOCALISED) - last_lost


def _round(quick: bool, sensor: sim.Sensor) -> dict[str, Any]:
    """Once around and on, on the blade: without and with loop closure."""
    motion = Round(3.5, 3.0) if quick else Round()
    sensor = sim.Sensor(120, 80, field_mm=6.0) if quick else sensor
    found: dict[str, Any] = {}
    for name, closing in (("without", False), ("with", True)):
        given, surface = _clouds("blade", motion, motion.period_s * 1.3, sensor)
        tracker = backends.make(loop_closure=closing)
        done = track(given, surface, tracker)
        if isinstance(tracker, LoopClosing):
            found["corrections"] = tracker.correction.number if tracker.correction else 0
            found["loops"], found["published_um"] = tracker.loops, done.ate().rms_um
            done.poses = list(tracker.trajectory()["T"])
        found[name] = {**done.figures(), **_plotted(done)}
    return found


def _part(quick: bool, sensor: sim.Sensor) -> dict[str, Any]:
    """The blade as a CAD model that lies elsewhere: with the first pose told, and searched for."""
    scene = sim.blade()

    def height(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.polynomial.polynomial.polyval2d(x, y, scene.coefficients), np.float64)

    vertices, faces = relief_mesh(height, (10.0, 7.0), 0.1)
    part = Part(rigid.apply(T_PART_SCENE, vertices), faces)
    found: dict[str, Any] = {}
    for name in ("told",) if quick else ("told", "searched"):
        off: list[list[float]] = []
        counts = dict.fromkeys(Fit, 0)
        registration: list[PartRegistration] = []

        def look(
            cloud: TrueCloud,
            done: Outcome,
            name: str = name,
            off: list[list[float]] = off,
            counts: dict[Fit, int] = counts,
            registration: list[PartRegistration] = registration,
        ) -> None:
            frame = visible_surface(done.tracker.view.live)
            if not registration:
                # Told as a person would place it: half a millimetre and a degree and a half off.
                near = T_PART_SCENE @ cloud.T_scene_camera @ rigid.exp([0.3, -0.3, 0.2, 0.02, -0.01, 0.02])
                registration.append(PartRegistration(part, frame.radius_mm, near if name == "told" else None))
            if len(done.poses) % LOOK_EVERY == 0:
                registration[0].look(*visible_points(done.tracker.map), done.poses[-1], frame)
            estimate = registration[0].estimate
            counts[estimate.state] += 1
            if estimate.state in (Fit.ALIGNED, Fit.DEGENERATE):
                told = estimate.T_part_world @ done.poses[-1]
                error = rigid.inverse(T_PART_SCENE @ cloud.T_scene_camera) @ told
                off.append([*(1e3 * error[:3, 3]), *(1e3 * rigid.rotation_log(error[:3, :3]))])

        given, surface = _clouds("blade", sim.HandMotion(), 0.6 if quick else 8.0, sensor)
        track(given, surface, backends.make(), look)
        errors = np.array(off).reshape(-1, 6)
        settled = errors[len(errors) // 2 :]
        found[name] = {
            "states": ", ".join(f"{state.value} {count}" for state, count in counts.items() if count),
            "rms_um": float(np.sqrt((settled[:, :3] ** 2).sum(axis=1).mean())) if len(settled) else None,
            "rms_mrad": float(np.sqrt((settled[:, 3:] ** 2).sum(axis=1).mean())) if len(settled) else None,
            "off_um": np.round(errors[:, :3], 3).tolist(),
        }
    return found


def _rendered(settings: Settings) -> dict[str, Any]:
    """The virtual rig's frames, all physics, through the decoder's own steps."""
    text, seconds = head_yaml(handheld.HEAD), 0.3 if settings.quick else 5.0
    run = VirtualRun(
        text, RENDERED, handheld.MOTION, handheld.PATTERNS, handheld.RATE_HZ, round(handheld.RATE_HZ * seconds),
        effects=FULL, bin_px=handheld.BIN_PX,
    )  # fmt: skip
    scene = parse(RENDERED, handheld.BASE_Z_MM)
    given = (
        TrueCloud(cloud.sequence, cloud.stamp_ns, cloud.channels, truth.T_scene_camera)
        for cloud, truth in clouds(settings, run, text)
    )
    done = track(given, lambda points: distance(scene, points), backends.make())
    return {**done.figures(), **_plotted(done)}


_COLUMNS = ("scan", "trajectory, rms / um", "max / um", "drift per s / um", "surface, std / um", "95 % / um", "clouds")


def _row(name: str, f: dict[str, Any]) -> tuple[str, ...]:
    keys = ("ate_um", "ate_max_um", "rpe_second_um", "surface_std_um", "surface_p95_um")
    return (name, *(f"{f[key]:.1f}" for key in keys), f["states"])


def _report(folder: Path, name: str, quick: bool, found: dict[str, Any]) -> Report:
    names = {
        "contour": "contour standard",
        "blade": "blade",
        "ball": "ball on plane",
        "plane": "plane",
        "halved": "contour, every second cloud missing",
        "occluded": "contour, occluded for 0.3 s",
    }
    bare, turn, part = found["bare"], found["round"], found["part"]
    tables = [
        Table("Simulated clouds", _COLUMNS, [_row(text, found[case]) for case, text in names.items()]),
        Table("Clouds decoded from rendered frames", _COLUMNS, [_row(RENDERED, found["rendered"])]),
        Table(
            "Degeneracy and occlusion",
            ("figure", "goal", "measured"),
            [
                ("without texture, contour: x / z, rms um", "10", "{0:.1f} / {2:.1f}".format(*bare["axes_um"])),
                ("without texture, contour: reported degenerate", "all", f"{bare['degenerate']:.0%}"),
                ("found after the occlusion, clouds", "", f"{found['occluded']['found_after']}"),
            ],
        ),
        Table(
            "A hand that goes around and comes back (blade)",
            _COLUMNS,
            [_row("as tracked, one map", turn["without"]), _row("loops closed, corrected path", turn["with"])],
        ),
        Table(
            "The tip in the part's coordinates (blade as CAD model), second half of the scan",
            ("first pose", "position, rms / um", "rotation, rms / mrad", "clouds"),
            [
                (how, *("-" if v is None else f"{v:.1f}" for v in (p["rms_um"], p["rms_mrad"])), p["states"])
                for how, p in part.items()
            ],
        ),
    ]
    if found["contour"]["features"]:
        rows = [(feature, f"{value:+.2f}") for feature, value in found["contour"]["features"].items()]
        tables.insert(1, Table("Features of the contour standard in the merged map", ("feature", "error"), rows))
    _plot_paths(folder / f"{name}-paths.png", found)
    _plot_part(folder / f"{name}-part.png", part)
    about = [
        f"{'A small version, a coarser grid and parts of seconds. ' if quick else ''}Simulated clouds: "
        f"{'240x160' if quick else '350x220'} rays on analytic surfaces, 10 um white noise, 1 % outliers, 15 % "
        "texture, a hand's motion of about 4 mm/s with tremor, 172 Hz; no decoder, no fibre. Rendered: all physics "
        f"of the virtual rig, head {handheld.HEAD}, `{handheld.PATTERNS}`, camera binned to 960x600, exact "
        "calibration. Trajectories are compared after the best rigid fit. "
        f"Around and back: {turn['loops']} loops found, {turn['corrections']} corrections of the map, "
        f"{turn['published_um']:.1f} um for the poses as they were published.",
    ]
    return Report(name, "Odometry", about, tables, [f"{name}-paths.png", f"{name}-part.png"], found)


def _plot_paths(path: Path, found: dict[str, Any]) -> None:
    """Errors of the position over the scan."""
    shown = {
        "contour standard, simulated clouds": found["contour"]["off_um"],
        "contour standard, rendered frames": found["rendered"]["off_um"],
        "around and back, as tracked": found["round"]["without"]["off_um"],
        "around and back, loops closed": found["round"]["with"]["off_um"],
    }
    with figure("Position error along the path", simulated=True, path=path, size_in=(8.5, 5.0)) as fig:
        for axes, (title, off) in zip(fig.subplots(2, 2).ravel(), shown.items(), strict=True):
            share = np.linspace(0.0, 1.0, len(off))
            for k, axis in enumerate("xyz"):
                axes.plot(share, np.array(off)[:, k], color=COLOURS[k], lw=0.8, label=axis)
            axes.set(title=title, xlabel="share of the scan", ylabel="error / um")
            axes.legend(ncols=3)


def _plot_part(path: Path, part: dict[str, Any]) -> None:
    """Errors of the tip in the part's coordinates."""
    with figure("The tip in the part's coordinates", simulated=True, path=path, size_in=(8.5, 2.8)) as fig:
        for axes, (how, one) in zip(np.atleast_1d(fig.subplots(1, len(part))), part.items(), strict=True):
            off = np.array(one["off_um"]).reshape(-1, 3)
            for k, axis in enumerate("xyz"):
                axes.plot(off[:, k], color=COLOURS[k], lw=0.8, label=axis)
            axes.set(title=f"first pose {how}", xlabel="clouds since it was found", ylabel="error / um")
            axes.legend(ncols=3)
