"""Logs of the virtual rig: rendered frames with the truth, as a live scan would record them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from recorded import START_NS, record

from endo3d.schemas import messages as m
from endo3d.services.runtime import stack_file
from endo3d_core import patterns
from endo3d_core.calibration import Rig
from endo3d_core.head import Head
from endo3d_core.virtual_rig import motion, scene
from endo3d_core.virtual_rig.effects import PRESETS
from endo3d_core.virtual_rig.renderer import Renderer

STACK = """[rig]
name = "virtual"
head = "base6_wd20"

[decoder]

[odometry]

[recorder]
"""
PATTERN_SET = "interleaved f1=15"
RATE_HZ = 172.0
EXPOSURE_US = 5200.0


def messages(frames: int, bin_px: int) -> list[m.Message]:
    """A hand-guided scan of the micro-contour standard, and the calibration it was made with."""
    yaml = stack_file.stock("heads")["base6_wd20"].read_text(encoding="utf-8")
    rig, pattern_set = Rig.from_yaml(yaml), patterns.parse(PATTERN_SET)
    renderer = Renderer(
        rig,
        Head.from_yaml(yaml),
        scene.parse("contour texture=noise:0.15"),
        PRESETS["fast"],
        bin_px=bin_px,
    )
    window = rig.projector
    lights = [renderer.light(patterns.image(p, window.width, window.height)) for p in pattern_set.patterns]
    path = motion.parse("hand seed=7")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rig.R, rig.t
    period_ns = round(1e9 / RATE_HZ)
    made: list[m.Message] = [
        m.CameraCalibration(START_NS, rig.camera.width, rig.camera.height, rig.camera.K, rig.camera.dist),
        m.ProjectorCalibration(START_NS, window.width, window.height, window.K, window.dist, T, yaml),
        m.Mode(START_NS, "interleaved", PATTERN_SET, 1, START_NS, period_ns, EXPOSURE_US, True),
    ]
    for k in range(frames):
        stamp_ns = START_NS + k * period_ns
        image = np.zeros((renderer.camera.height, renderer.camera.width), np.uint8)
        slot = k % len(pattern_set)
        poses = renderer.poses(path.T_scene_camera, k / RATE_HZ, EXPOSURE_US)
        renderer.frame(lights[slot], poses, EXPOSURE_US, k, image)
        trigger_ns = stamp_ns - round(EXPOSURE_US * 500)
        made += (
            m.Frame(stamp_ns, k, image, PATTERN_SET, slot, 1, EXPOSURE_US, trigger_ns, k),
            m.Truth(stamp_ns, k, path.T_scene_camera(k / RATE_HZ), renderer.scene.text),
        )
    return made


def write(path: Path, frames: int, bin_px: int, **config: object) -> Path:
    return record(path, messages(frames, bin_px), stack_toml=STACK, rig="virtual", **config)
