"""How the sensor head moves: T_scene_camera as a pure function of time.

still
stage v=2 along=x            a linear stage, mm/s; along=0.6,0,0.8 for any direction
hand seed=7 reach=5          drift along the contour, tremor, small rotations; begins at rest
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from endo3d_core.rigid import rotation_exp
from endo3d_core.virtual_rig.words import Words

Pose = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """A path of the head; the scene's axes are the camera's at time 0."""

    text: str
    T_scene_camera: Callable[[float], Pose]
    """Seconds -> (4, 4), mm."""


def parse(text: str) -> Motion:
    """Text -> motion. Raises ``ValueError`` that says what is wrong."""
    words = Words.parse(text, "motion")
    match words.kind:
        case "still":
            words.finish()
            return Motion(text, lambda t_s: np.eye(4))
        case "stage":
            velocity = words.number("v", 2.0) * _direction(words.text_of("along", "x"))
            start = words.vector("start", (0.0, 0.0, 0.0))
            words.finish()
            return Motion(text, lambda t_s: transform(start + velocity * t_s))
        case "hand":
            hand = Hand(int(words.number("seed", 7)), words.number("reach", 5.0), words.number("speed", 3.0))
            words.finish()
            return Motion(text, hand.at)
        case _:
            raise ValueError(f"unknown motion {words.kind!r}; it is one of: still, stage, hand")


class Hand:
    """A hand that scans back and forth along x: drift of 2..4 mm/s, tremor of 50..100 um, small rotations."""

    SETTLE_S = 1.0
    """Drift and tremor grow from rest within this time."""
    TURN_SHARPNESS = 0.97
    """1 is a triangle wave; below, the hand slows down before it turns."""

    def __init__(self, seed: int, reach_mm: float, speed_mm_s: float) -> None:
        rng = np.random.default_rng(seed)
        self.reach_mm = reach_mm
        self.rate = math.asin(self.TURN_SHARPNESS) / self.TURN_SHARPNESS * speed_mm_s / max(reach_mm, 1e-9)
        self.breath = rng.uniform(0.15, 0.45, 6) * 2 * math.pi
        self.breath_phase = rng.uniform(0, 2 * math.pi, 6)
        self.breath_size = np.array([0.0, 0.8, 0.5, *np.radians([1.0, 1.5, 1.0])])
        self.tremor = rng.uniform(8.0, 12.0, (6, 3)) * 2 * math.pi
        self.tremor_phase = rng.uniform(0, 2 * math.pi, (6, 3))
        amplitude_mm = rng.uniform(0.050, 0.100, 6)
        share = rng.dirichlet((2.0, 2.0, 2.0), 6)
        # A rotation of 1 mrad moves the field by 20 um at WD 20: the tremor's rotations stay of that size.
        self.tremor_size = share * (amplitude_mm * np.array([1, 1, 1, 0.02, 0.02, 0.02]))[:, None]

    def at(self, t_s: float) -> Pose:
        """T_scene_camera at a time; before 0 the hand rests."""
        t = max(t_s, 0.0)
        grown = _smooth(t / self.SETTLE_S)
        drift_s = self.SETTLE_S * _smooth_integral(t / self.SETTLE_S)
        q = self.breath_size * (np.sin(self.breath * drift_s + self.breath_phase) - np.sin(self.breath_phase))
        sweep = math.asin(self.TURN_SHARPNESS * math.sin(self.rate * drift_s))
        q[0] += self.reach_mm * sweep / math.asin(self.TURN_SHARPNESS)
        wave = np.sin(self.tremor * t + self.tremor_phase) * self.tremor_size
        q += grown * wave.sum(axis=1)
        return transform(q[:3], q[3:])


def transform(translation_mm: ArrayLike, rotation_rad: ArrayLike = (0.0, 0.0, 0.0)) -> Pose:
    """(4, 4) from a translation and a rotation vector."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_exp(rotation_rad), translation_mm
    return T


def _smooth(s: float) -> float:
    """0 to 1 with zero slope at both ends."""
    s = min(max(s, 0.0), 1.0)
    return s * s * (3.0 - 2.0 * s)


def _smooth_integral(s: float) -> float:
    """Integral of ``_smooth`` from 0."""
    return s**3 - 0.5 * s**4 if s < 1.0 else s - 0.5


def _direction(text: str) -> NDArray[np.float64]:
    axes = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
    try:
        vector = np.array(axes.get(text) or [float(v) for v in text.split(",")], np.float64)
        length = float(np.linalg.norm(vector))
    except ValueError:
        length = 0.0
    if length == 0.0 or vector.shape != (3,):
        raise ValueError(f"along={text} is not an axis (x, y, z) nor three numbers like 0.6,0,0.8")
    return np.asarray(vector / length)
