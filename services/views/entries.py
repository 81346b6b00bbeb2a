"""One function per message: what it looks like in Rerun, as entries ``path: archetypes``.

The tree: /world (map, way of the tip, camera with its image, cloud and projector), /depth, /plots, /log.
Lengths are mm; the world is what the first pose calls it, with OpenCV's axes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from endo3d.schemas import messages as m
from endo3d.services.views.colour import packed, spread
from endo3d.services.views.colouring import by_nearness, by_quality
from endo3d.services.views.scan import xyz

WORLD, CAMERA = "world", "world/camera"
IMAGE, CLOUD, MAP, WAY = "world/camera/image", "world/camera/cloud", "world/map", "world/way"
PROJECTOR, DEPTH, LOG, PLOTS = "world/camera/projector", "depth", "log", "plots"

CLOUD_RADIUS_MM = 0.02
PLANE_MM = 6.0
"""Where the camera's image hangs in the frustum."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One thing to log: where, what, and about how many bytes it is."""

    path: str
    what: Any
    size: int = 256
    static: bool = False
    width: int = 0
    """Of an image, px."""


def world() -> Iterator[Entry]:
    """What never changes."""
    yield Entry(WORLD, rr.ViewCoordinates.RDF, static=True)
    for name, colour in (
        ("residual_um", (88, 152, 214)),
        ("sigma_weak_um", (216, 102, 63)),
        ("inlier_share", (63, 191, 134)),
    ):
        yield Entry(f"{PLOTS}/pose/{name}", rr.SeriesLines(colors=colour, names=name, widths=1.5), static=True)


def frame(message: m.Frame) -> Iterator[Entry]:
    """The camera image as a grey JPEG, halved while it is wider than 1000 px."""
    image = grey(message.image)
    while image.shape[1] > 1000:
        image = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
    encoded = cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, 85))[1].tobytes()
    yield Entry(IMAGE, rr.EncodedImage(contents=encoded, media_type="image/jpeg"), len(encoded), width=image.shape[1])


def grey(image: NDArray[Any]) -> NDArray[np.uint8]:
    """(height, width) uint8 of 8 or 16 bit grey values."""
    return image if image.dtype == np.uint8 else (image >> 8).astype(np.uint8)


def camera(message: m.CameraCalibration, image_width: int) -> Iterator[Entry]:
    """The frustum, in pixels of the image as shown; Rerun's pinhole has no distortion."""
    yield Entry(IMAGE, _pinhole(message.K, message.width, message.height, image_width), static=True)


def projector(message: m.ProjectorCalibration) -> Iterator[Entry]:
    """Where the projector stands beside the camera."""
    T_camera_projector = np.linalg.inv(message.T_projector_camera)
    yield Entry(PROJECTOR, rigid(T_camera_projector.astype(np.float64)), static=True)
    yield Entry(PROJECTOR, _pinhole(message.K, message.width, message.height, message.width), static=True)


def _pinhole(K: NDArray[np.float64], width: int, height: int, shown_width: int) -> rr.Pinhole:
    scale = shown_width / width
    focal, centre = (K[0, 0] * scale, K[1, 1] * scale), (K[0, 2] * scale, K[1, 2] * scale)
    return rr.Pinhole(
        resolution=(shown_width, height * scale),
        focal_length=focal,
        principal_point=centre,
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=PLANE_MM,
    )


def rigid(T: NDArray[np.float64]) -> rr.Transform3D:
    """A (4, 4) pose as the transform of its child."""
    return rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3])


def cloud(message: m.Cloud, colour: str) -> Iterator[Entry]:
    """The points of one measurement that are valid, in the camera frame: by quality, or else by height."""
    points = message.points[np.isfinite(message.points["z"])]
    if len(points):
        shown = by_quality(points) if colour == "quality" else by_nearness(points)
        yield points_entry(CLOUD, xyz(points), shown.rgb(), CLOUD_RADIUS_MM)


def points_entry(path: str, positions: NDArray[np.float32], rgb: NDArray[np.uint8], radius_mm: float) -> Entry:
    """Points with colours packed into words, which Rerun takes as they are."""
    return Entry(path, rr.Points3D(positions, colors=packed(rgb), radii=radius_mm), 16 * len(positions))


def depth(message: m.DepthMap) -> Iterator[Entry]:
    """The depth map as a 16-bit PNG, scaled so that a hovering pointer reads mm above the offset."""
    encoded = cv2.imencode(".png", message.depth, (cv2.IMWRITE_PNG_COMPRESSION, 1))[1].tobytes()
    values = message.depth[::4, ::4]
    low, high = spread(values[values > 0].astype(np.float32))
    what = rr.EncodedDepthImage(
        blob=encoded,
        media_type="image/png",
        meter=1 / message.scale_mm,
        colormap="viridis",
        depth_range=(low, high),
    )
    yield Entry(DEPTH, what, len(encoded))


def pose(message: m.Pose) -> Iterator[Entry]:
    """Where the tip is, and three curves of how well that is known."""
    yield Entry(CAMERA, rigid(message.T_world_camera))
    for name in ("residual_um", "sigma_weak_um", "inlier_share"):
        value = float(getattr(message, name))
        if np.isfinite(value):
            yield Entry(f"{PLOTS}/pose/{name}", rr.Scalars(value))


def way(positions: NDArray[np.floating]) -> Iterator[Entry]:
    """The way of the tip so far, (n, 3) mm."""
    strip = rr.LineStrips3D([positions], colors=(255, 166, 77), radii=0.03)
    yield Entry(WAY, strip, positions.nbytes)


def nothing(*paths: str) -> Iterator[Entry]:
    """What was shown there goes."""
    for path in paths:
        yield Entry(path, rr.Clear(recursive=False))


def status(message: m.Status) -> Iterator[Entry]:
    """Rate and latency of one service."""
    yield Entry(f"{PLOTS}/rate_hz/{message.service}", rr.Scalars(message.rate_hz))
    yield Entry(f"{PLOTS}/latency_p50_ms/{message.service}", rr.Scalars(message.latency_p50_ms))
    dropped = float(sum(message.dropped.values()))
    yield Entry(f"{PLOTS}/dropped/{message.service}", rr.Scalars(dropped))


def mode(message: m.Mode) -> Iterator[Entry]:
    """A line in the log: what the projector shows from now on."""
    text = f"{message.mode}: {message.pattern_set}, epoch {message.epoch}" + ("" if message.running else ", stopped")
    yield Entry(f"{LOG}/mode", rr.TextLog(text, level="INFO"))


LEVELS = {m.Level.WARNING: "WARN", m.Level.FATAL: "CRITICAL"}


def log_line(message: m.LogLine) -> Iterator[Entry]:
    """A service's words."""
    level = LEVELS.get(message.level, message.level.upper())
    yield Entry(f"{LOG}/{message.service}", rr.TextLog(message.message, level=level))
