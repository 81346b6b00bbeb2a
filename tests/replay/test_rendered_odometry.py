"""The demo's chain without processes: rendered frames through the decoder's and the odometry's own steps."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import rendered

from endo3d.schemas.messages import MapDelta, Message, Pose, Tracking, Truth
from endo3d.services.decoder import Decoder, DecoderConfig
from endo3d.services.odometry import Odometry, OdometryConfig
from endo3d_core import metrology, rigid, trajectory
from endo3d_core.virtual_rig import scene
from endo3d_core.virtual_rig.truth import distance

FRAMES = 70


def run(messages: list[Message]) -> Iterator[Message]:
    """Everything odometry says about the decoder's clouds."""
    decoder, odometry = Decoder(DecoderConfig()), Odometry(OdometryConfig())
    for message in messages:
        for cloud in decoder.step(message):
            yield from odometry.step(cloud)
    yield from (m for m in odometry.command("snapshot", {}, 0) if isinstance(m, MapDelta))


def test_a_rendered_scan_is_tracked_and_its_map_is_the_standard() -> None:
    messages = rendered.messages(FRAMES, bin_px=2)
    truths = {m.sequence: m for m in messages if isinstance(m, Truth)}
    told = list(run(messages))
    poses = [m for m in told if isinstance(m, Pose)]
    assert len(poses) >= FRAMES - 8
    assert {p.state for p in poses} == {Tracking.TRACKING}
    estimated = np.array([p.T_world_camera for p in poses])
    true = np.array([truths[p.sequence].T_scene_camera for p in poses])
    assert trajectory.ate(estimated, true).rms_um < 30.0
    world = [m for m in told if isinstance(m, MapDelta)][-1]
    T_scene_world = true[0] @ rigid.inverse(estimated[0])
    seen = world.points[world.points["count"] >= 10]
    points = rigid.apply(T_scene_world, np.stack([seen[axis] for axis in "xyz"], axis=1))
    standard = scene.parse(truths[poses[0].sequence].scene, 20.0)
    error = metrology.surface_error(points, lambda p: distance(standard, p))
    assert error.count > 10_000
    assert np.median(np.abs(1e3 * distance(standard, points))) < 10.0
