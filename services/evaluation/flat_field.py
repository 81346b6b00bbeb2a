"""The camera fibre's core map, as one would make it: from images of a white plane in even light."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from endo3d_core.calibration import Rig
from endo3d_core.fibre import CoreMap
from endo3d_core.head import Head
from endo3d_core.virtual_rig import scene
from endo3d_core.virtual_rig.effects import FULL
from endo3d_core.virtual_rig.renderer import Renderer

IMAGES = 16
"""Whose mean the flat is."""
EXPOSURE_US = 250e3
"""Room light is dim: the brightest cores reach two thirds of the range."""
FIRST_NUMBER = 1 << 30
"""Seeds the noise of the flat's images: no other image has it."""


def flat_field(head_yaml: str) -> NDArray[np.float64]:
    """(height, width) mean image of a white plane under ambient light alone, the projector dark; with noise."""
    rig, head = Rig.from_yaml(head_yaml), Head.from_yaml(head_yaml)
    renderer = Renderer(rig, head, scene.parse("plane", head.working_distance_mm), FULL)
    dark = renderer.light(np.zeros((rig.projector.height, rig.projector.width), np.uint8))
    image = np.empty((rig.camera.height, rig.camera.width), np.uint8)
    total = np.zeros(image.shape)
    for k in range(IMAGES):
        renderer.frame(dark, [np.eye(4)], EXPOSURE_US, FIRST_NUMBER + k, image)
        total += image
    return total / IMAGES


def core_map(head_yaml: str, folder: Path) -> Path:
    """The file of the head's core map in the folder, made when it isn't there."""
    path = folder / f"{hashlib.sha256(head_yaml.encode()).hexdigest()[:12]}.fibre.npz"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        path.write_bytes(CoreMap.find(flat_field(head_yaml)).to_npz())
    return path
