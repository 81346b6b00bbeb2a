"""From triggers to clouds: whatever is lost or late on the way, no frame is decoded as another slot's."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import endo3d.deploy
from endo3d.schemas.messages import Cloud, Frame, Mode
from endo3d.services.decoder import Decoder, DecoderConfig
from endo3d.services.devices.labels import Labels
from endo3d.services.devices.slots import timeline
from endo3d_core import patterns
from endo3d_core.calibration import Rig
from endo3d_core.head import Head
from endo3d_core.virtual_rig import scene as scenes
from endo3d_core.virtual_rig.effects import PRESETS
from endo3d_core.virtual_rig.renderer import Renderer

HEAD = Path(endo3d.deploy.__path__[0]) / "heads" / "base6_wd20.yaml"
SET = patterns.parse("interleaved f1=15")
EXPOSURE_US, DARK_US = 7471.0, 105.0
PERIOD_NS = 7_576_000
START_NS = 1_700_000_000_000_000_000
EXPOSURES = 300


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    """Per slot, the image of a still scene: right windows give bit-equal clouds."""
    text = HEAD.read_text()
    rig, head = Rig.from_yaml(text), Head.from_yaml(text)
    scene = scenes.parse("contour texture=noise:0.15", head.working_distance_mm)
    renderer = Renderer(rig, head, scene, PRESETS["fast"], bin_px=4)
    made = []
    for slot, pattern in enumerate(SET.patterns):
        image = np.empty((renderer.camera.height, renderer.camera.width), renderer.sensor.dtype)
        light = renderer.light(patterns.image(pattern, rig.projector.width, rig.projector.height))
        renderer.frame(light, [np.eye(4)], EXPOSURE_US, slot, image)
        made.append(image)
    return made


@dataclass(frozen=True)
class Trouble:
    """Shares of the exposures, and how wrong the start and the camera's clock are."""

    triggers_lost: float = 0.0
    frames_lost: float = 0.0
    late: float = 0.0
    bursts: int = 0
    start_error: float = 0.0
    drift_ppm: float = 0.0
    seed: int = 0


def exposed(trouble: Trouble, images: list[np.ndarray]) -> Iterator[tuple[int, int, int]]:
    """Pattern count, stamp and the camera's frame id of what arrives at the host."""
    rng = np.random.default_rng(trouble.seed)
    missed = rng.random(EXPOSURES) < trouble.triggers_lost
    for start in rng.integers(20, EXPOSURES, trouble.bursts):
        missed[start : start + rng.integers(1, 12)] = True
    missed[:3] = False
    frame_id = -1
    for count in np.flatnonzero(~missed):
        frame_id += 1  # contiguous although triggers were missed
        if rng.random() < trouble.frames_lost:
            continue
        true_ns = int(count) * PERIOD_NS
        stamp_ns = START_NS + round(true_ns * (1 + trouble.drift_ppm * 1e-6) + trouble.start_error * PERIOD_NS)
        if count > 3 and rng.random() < trouble.late:
            stamp_ns += round(rng.uniform(0.36, 0.64) * PERIOD_NS)
        yield int(count), stamp_ns, frame_id


def run(trouble: Trouble, images: list[np.ndarray]) -> tuple[list[tuple[int, Frame]], list[Cloud]]:
    """True pattern counts with the frames as they were labelled, and the clouds."""
    labels = Labels()
    labels.add(Mode(START_NS, "interleaved", SET.text, 1, START_NS, PERIOD_NS, EXPOSURE_US, running=True))
    decoder = Decoder(DecoderConfig(head=str(HEAD), bin_px=2, depth=False))
    decoder.open()
    frames, clouds = [], []
    for count, stamp_ns, frame_id in exposed(trouble, images):
        label = labels.of(stamp_ns)
        assert label is not None
        frame = Frame(
            stamp_ns, label.sequence, images[count % 4], label.pattern_set, label.slot, label.epoch,
            EXPOSURE_US, stamp_ns, frame_id,
        )  # fmt: skip
        frames.append((count, frame))
        clouds += [message for message in decoder.step(frame) if isinstance(message, Cloud)]
    return frames, clouds


@pytest.fixture(scope="module")
def right(images: list[np.ndarray]) -> set[bytes]:
    """The clouds of an undisturbed run: one per slot of the window's middle."""
    _, clouds = run(Trouble(), images)
    assert len(clouds) > EXPOSURES - 20
    assert all(cloud.valid_count > 0.2 * cloud.points.size for cloud in clouds)
    different = {cloud.points.tobytes() for cloud in clouds}
    assert len(different) == 4
    return different


@pytest.mark.parametrize(
    "trouble",
    [
        Trouble(triggers_lost=0.03),
        Trouble(frames_lost=0.03),
        Trouble(late=0.03),
        Trouble(bursts=12),
        Trouble(start_error=0.4, drift_ppm=100),
        *(Trouble(0.02, 0.02, 0.02, 4, -0.35, -80, seed) for seed in (1, 2)),
    ],
    ids=str,
)
def test_no_wrong_slot_is_decoded(trouble: Trouble, images: list[np.ndarray], right: set[bytes]) -> None:
    frames, clouds = run(trouble, images)
    assert all(frame.slot in (count % 4, -1) for count, frame in frames)
    assert len(clouds) > 0.2 * EXPOSURES
    wrong = [cloud.sequence for cloud in clouds if cloud.points.tobytes() not in right]
    assert wrong == []


def test_timeline_and_mode_agree() -> None:
    shown = timeline(SET, START_NS, EXPOSURE_US, DARK_US)
    assert shown.trigger_ns(4) - shown.trigger_ns(0) == 4 * PERIOD_NS
