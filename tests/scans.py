"""A small made-up scan with known numbers, for tests of what comes after the scan."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from endo3d.schemas import codec, topics
from endo3d.schemas import messages as m
from endo3d.services.archive.entry import Entry
from endo3d.services.archive.recording import Recording
from endo3d.services.archive.writer import Kind
from endo3d.services.views.colouring import visible
from endo3d_core.merging import MAP_POINT

START_NS = 1_700_000_000_123_456_789
K = np.array([[800.0, 0, 240.0], [0, 805.0, 150.0], [0, 0, 1]])
DIST = np.array([-0.1, 0.02, 1e-3, -2e-3, 0.003])
HEIGHT, WIDTH = 30, 48


def pose_of(k: int) -> NDArray[np.float64]:
    """T_world_camera: a step along x and a small turn per frame."""
    angle = np.deg2rad(0.5 * k)
    T = np.eye(4)
    T[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    T[:3, 3] = [0.25 * k, -0.1 * k, 0.02 * k]
    return T


def points_of(k: int) -> NDArray[np.void]:
    """(HEIGHT, WIDTH) of POINT: a wavy surface, the corner invalid."""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
    points = np.full((HEIGHT, WIDTH), np.nan, m.POINT)
    points["z"] = 20 + 0.3 * np.sin(u / 5 + k) + 0.01 * v
    points["x"], points["y"] = (u - 24) * 0.2, (v - 15) * 0.2
    points["intensity"], points["quality"], points["sigma"] = 100 + u, 0.5 + v / 100, 0.005
    for name in ("x", "y", "z"):
        points[name][:3, :4] = np.nan
    return points


def map_of(points: NDArray[np.void], voxel_mm: float = 0.2) -> NDArray[np.void]:
    """(n,) MAP_POINT of a cloud's valid points, in the world = camera frame."""
    valid = points[np.isfinite(points["z"])]
    rows = np.zeros(len(valid), MAP_POINT)
    for name in ("x", "y", "z", "intensity", "sigma"):
        rows[name] = valid[name]
    rows["nz"], rows["count"] = -1, 4
    for key, axis in (("kx", "x"), ("ky", "y"), ("kz", "z")):
        rows[key] = np.floor(valid[axis] / voxel_mm)
    return rows


def information_of() -> NDArray[np.float64]:
    """1-sigma of 2, 3, 5 um and 0.1, 0.2, 0.4 mrad."""
    return np.diag(np.array([2e-3, 3e-3, 5e-3, 1e-4, 2e-4, 4e-4]) ** -2.0)


def messages(
    frames: int = 6, hz: float = 25.0, shape: tuple[int, int] = (300, 480), start_s: float = 0.0
) -> Iterator[m.Message]:
    """What a short simulated run leaves in a log: images of that shape at ``hz``, everything else small."""
    yield m.CameraCalibration(START_NS, 480, 300, K, DIST)
    T_projector_camera = np.eye(4)
    T_projector_camera[0, 3] = -6.0
    yield m.ProjectorCalibration(START_NS, 960, 960, K, DIST, T_projector_camera, "text")
    yield m.Mode(START_NS, "interleaved", "interleaved f1=25", 1, START_NS, 40_000_000, 4000.0, True)
    rng = np.random.default_rng(3)
    image = rng.integers(0, 256, shape, np.uint8)
    for k in range(frames):
        stamp_ns = START_NS + round(1e9 * (start_s + k / hz))
        yield m.Frame(stamp_ns, k, image, "interleaved f1=25", k % 6, 1, 4000.0, stamp_ns - 2_000_000, k)
        points = points_of(k)
        valid = np.isfinite(points["z"])
        yield m.Cloud(stamp_ns, k, points, 3, stamp_ns, 1, "interleaved f1=25", 10.0, int(valid.sum()))
        depth = np.where(valid, np.round((np.nan_to_num(points["z"]) - 14.0) / 2e-4), 0).astype(np.uint16)
        yield m.DepthMap(stamp_ns, k, depth, 2e-4, 14.0, 10.0)
        T = pose_of(k)
        yield m.Truth(stamp_ns, k, T, "plane", 4.3)
        yield m.Pose(
            stamp_ns,
            k,
            T,
            information_of(),
            m.Tracking.TRACKING,
            4.0,
            np.eye(6)[0],
            0.9,
            6.0,
            0.3,
            0,
            stamp_ns,
        )
        yield m.Transform(stamp_ns, "world", "camera", T)
        rows = visible(map_of(points), -21.0, -19.0)
        yield m.MapDelta(stamp_ns, k, rows, np.zeros((0, 3), np.int16), k, k == 0, len(rows), 0.2)
        yield m.Status(stamp_ns, "decoder", "host", 1, m.ServiceState.RUNNING, "", 25.0, 9.0, 14.0, 0.4, 120.0)
        yield m.LogLine(stamp_ns, m.Level.INFO, f"frame {k}", "decoder")


def write_log(path: Path, frames: int = 4) -> None:
    """The same as a log, as a recorder would have written it."""
    recording = Recording(path, {})
    for sequence, message in enumerate(messages(frames)):
        topic = topics.of(message)
        kind = Kind(*codec.schema(topic))
        channel = topic.channel(getattr(message, "service", ""))
        payload = (codec.encode(message),)
        arrived_ns = message.stamp_ns + sequence
        recording.put(Entry(channel, kind, sequence, arrived_ns, message.stamp_ns, payload))
    recording.finish()
