"""One picture that tells a scan: the merged cloud, the way of the tip, what the camera saw, how it went."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from endo3d.services.views import figures
from endo3d.services.views.colour import spread
from endo3d.services.views.colouring import Colouring, colouring
from endo3d.services.views.principal import principal, without_strays
from endo3d.services.views.scan import Scan, xyz
from endo3d.services.views.splat import BACKGROUND, Eye, looking, oblique, render

SIZE_PX = (2400, 1350)
SCENE_PX, WORDS_PX = (1650, 1190), 160
"""The cloud, and the strip above it for the title."""
WAY_RGB = (255, 166, 77)
FRUSTUM_RGB = (255, 214, 160)
MOST_POINTS = 3_000_000


def picture(
    scan: Scan,
    path: str | Path,
    *,
    colour: str = "height",
    deviation_um: NDArray[np.floating] | None = None,
    title: str = "",
) -> None:
    """Writes a PNG of 2400 x 1350.

    colour is ``height``, ``quality`` or ``deviation``; the last needs ``deviation_um`` (n,), the signed
    distance of every point of ``scan.points()`` from the truth.
    """
    points = scan.points()
    with figures.house_style(night=True):
        fig = Figure(figsize=(SIZE_PX[0] / 150, SIZE_PX[1] / 150))
        scene = fig.add_axes((0, 0, SCENE_PX[0] / SIZE_PX[0], 1))
        scene.set_axis_off()
        if len(points) > 2:
            shown = colouring(points, colour, scan.viewer(), deviation_um)
            image = three_d(scan, xyz(points), shown.rgb())
            above = np.broadcast_to(BACKGROUND[0].astype(np.uint8), (WORDS_PX, SCENE_PX[0], 3))
            scene.imshow(np.concatenate([above, image]), interpolation="none")
            _ramp(fig, shown)
        _words(fig, scan, len(points), title)
        left, width = 0.728, 0.254
        _image(fig.add_axes((left, 0.665, width, 0.275)), scan)
        _depth(fig.add_axes((left, 0.345, width - 0.025, 0.275)), scan)
        _plots(fig.add_axes((left + 0.018, 0.060, width - 0.018, 0.225)), scan)
        fig.savefig(path, dpi=150)


def three_d(
    scan: Scan, points: NDArray[np.float32], rgb: NDArray[np.uint8], size: tuple[int, int] = SCENE_PX
) -> NDArray[np.uint8]:
    """(height, width, 3) uint8: the cloud, the tip's way and the camera's frustum, in perspective."""
    thin = max(1, -(-len(points) // MOST_POINTS))
    points, rgb = points[::thin], rgb[::thin]
    axes, centre = principal(points, scan.viewer())
    track = scan.track()
    frustum = _frustum(scan, track[-1]) if len(track) else np.empty((0, 3))
    bulk = without_strays(points[:: max(1, len(points) // 50_000)])
    seen = np.concatenate([bulk, track[:, :3, 3], frustum])
    eye = looking(seen, oblique(axes), axes[2], (2 * size[0], 2 * size[1]))
    image, depth = render(points, rgb, eye, _spacing_mm(points, scan.merged.merging_distance_mm))
    if len(track):
        _line(image, depth, eye, track[:, :3, 3], WAY_RGB, 5)
        for edge in _edges(frustum):
            _line(image, depth, eye, edge, FRUSTUM_RGB, 3)
    _scale_bar(image, eye, centre)
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)  # type: ignore[return-value]


def _spacing_mm(points: NDArray[np.float32], merging_distance_mm: float) -> float:
    """The disc's radius: what closes a surface of such points without washing it out."""
    if merging_distance_mm:
        return 0.9 * merging_distance_mm
    extent = np.sort(np.ptp(points, axis=0))[1:]
    return float(1.2 * np.sqrt(extent.prod() / len(points)))


def _frustum(scan: Scan, T_world_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """(5, 3) world mm: the tip, and the image's corners at the working distance."""
    if scan.camera is None:
        return T_world_camera[None, :3, 3]
    distance = scan.working_distance_mm if np.isfinite(scan.working_distance_mm) else 10.0
    w, h = scan.camera.width, scan.camera.height
    corners = np.array([[0, 0, 1], [w, 0, 1], [w, h, 1], [0, h, 1]], float)
    rays = corners @ np.linalg.inv(scan.camera.K).T * (0.9 * distance)
    local = np.concatenate([np.zeros((1, 3)), rays])
    return np.asarray(local @ T_world_camera[:3, :3].T + T_world_camera[:3, 3])


def _edges(frustum: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    if len(frustum) < 5:
        return []
    tip, *corners = frustum
    rim = [*corners, corners[0]]
    return [np.array(rim), *(np.array([tip, corner]) for corner in corners)]


def _line(
    image: NDArray[np.uint8],
    depth: NDArray[np.float32],
    eye: Eye,
    points: NDArray[np.float64],
    rgb: tuple[int, int, int],
    width_px: int,
) -> None:
    """A line in space; where the cloud hides it, it is faint."""
    at = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    fine = np.linspace(0, at[-1], max(2, min(4000, int(at[-1] / 0.05))))
    uvd = eye.project(np.stack([np.interp(fine, at, axis) for axis in points.T], axis=1))
    u, v = np.clip(np.round(uvd[:, :2]), 0, (eye.width - 1, eye.height - 1)).astype(int).T
    hidden = uvd[:, 2] > depth[v, u]
    pixels = np.round(uvd[:, :2] * 16).astype(np.int32)
    faint = image.copy()
    for run in np.split(np.arange(len(fine)), np.flatnonzero(np.diff(hidden)) + 1):
        joined = pixels[run[0] : run[-1] + 2].reshape(-1, 1, 2)
        cv2.polylines(faint if hidden[run[0]] else image, [joined], False, rgb, width_px, cv2.LINE_AA, 4)
    if hidden.any():
        cv2.addWeighted(faint, 0.3, image, 0.7, 0, dst=image)


def _scale_bar(image: NDArray[np.uint8], eye: Eye, centre: NDArray[np.float64]) -> None:
    """A length that is right at the cloud's centre."""
    mm_per_px = eye.project(centre)[0, 2] / eye.focal_px
    length = figures.scale_bar_mm(mm_per_px * eye.width)
    left, right, at = 120, round(120 + length / mm_per_px), eye.height - 130
    cv2.line(image, (left, at), (right, at), (228, 230, 234), 6, cv2.LINE_AA)
    text = f"{length:g} mm"
    cv2.putText(image, text, (left, at - 22), cv2.FONT_HERSHEY_DUPLEX, 1.5, (228, 230, 234), 2, cv2.LINE_AA)


def _ramp(fig: Figure, shown: Colouring) -> None:
    axes = fig.add_axes((0.470, 0.085, 0.18, 0.014))
    extent = (shown.low, shown.high, 0, 1)
    axes.imshow(np.linspace(0, 1, 256)[None], aspect="auto", cmap=figures.RAMPS[shown.ramp], extent=extent)
    axes.set_yticks([])
    axes.grid(False)
    axes.set_title(shown.label, fontsize=8.5, loc="left", pad=4)


def _words(fig: Figure, scan: Scan, count: int, title: str) -> None:
    fig.text(0.025, 0.955, title or "endo3d", fontsize=20, fontweight="bold", va="top")
    rate = f" at {(scan.frames - 1) / scan.seconds:.0f} Hz" if scan.seconds else ""
    facts = [f"{scan.frames} frames{rate}", f"{count} points", f"tip moved {scan.length_mm():.0f} mm"]
    if scan.merged.merging_distance_mm:
        facts.insert(2, f"merged at {1e3 * scan.merged.merging_distance_mm:.0f} um")
    fig.text(0.025, 0.908, "   ·   ".join(facts), fontsize=10, va="top", color="#b9bec7")
    if scan.simulated:
        scene = scan.truths[-1].scene.split()[0]
        text = f"simulated frames: virtual rig, scene {scene}"
        fig.text(0.025, 0.880, text, fontsize=10, va="top", style="italic", color=figures.COLOURS[1])
    fig.text(0.025, 0.028, "orange: way of the tip, camera frustum at the last pose", fontsize=8, color="#b9bec7")


def _image(axes: Axes, scan: Scan) -> None:
    axes.set_title("camera")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.grid(False)
    if scan.frame is None:
        return
    axes.set_title(f"camera, frame {scan.frame.sequence}: pattern {scan.frame.slot} of {scan.frame.pattern_set}"[:78])
    axes.imshow(scan.frame.image, cmap="gray", vmin=0, vmax=float(scan.frame.image.max()) or 1)


def _depth(axes: Axes, scan: Scan) -> None:
    axes.set_title("depth / mm")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.grid(False)
    if scan.depth is None:
        return
    z_mm = np.where(scan.depth.depth > 0, scan.depth.offset_mm + scan.depth.scale_mm * scan.depth.depth, np.nan)
    low, high = spread(z_mm)
    shown = axes.imshow(z_mm, cmap=figures.RAMPS["height"].reversed(), vmin=low, vmax=high)
    beside = axes.inset_axes((1.015, 0.0, 0.02, 1.0))
    axes.figure.colorbar(shown, cax=beside).outline.set_visible(False)


def _plots(axes: Axes, scan: Scan) -> None:
    axes.set(title="registration", xlabel="time / s", ylabel="um")
    if not scan.poses:
        return
    start = scan.first_ns or scan.poses[0].stamp_ns
    seconds = np.array([(pose.stamp_ns - start) * 1e-9 for pose in scan.poses])
    most = 0.0
    for name, label, line in (
        ("residual_um", "residual", figures.COLOURS[0]),
        ("sigma_weak_um", "1-sigma, weakest direction", figures.COLOURS[1]),
    ):
        values = np.array([getattr(pose, name) for pose in scan.poses])
        most = max(most, spread(values)[1])
        axes.plot(seconds, np.where(values > 0, values, np.nan), color=line, lw=0.9, label=label)
    axes.set_ylim(0, 1.4 * max(most, 1.0))
    axes.legend(loc="upper right", ncols=2, bbox_to_anchor=(1, 1.16), borderpad=0)
