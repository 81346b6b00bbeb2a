"""Sequencer and grabber over the simulated devices: every frame shows what its label says, also across switches."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from endo3d.schemas.messages import CameraCalibration, Frame, Message, Mode, ProjectorCalibration, Truth
from endo3d.services.devices.uri import Setting
from endo3d.services.grabber import Grabber
from endo3d.services.runtime.errors import UserError
from endo3d.services.runtime.service import Refused
from endo3d.services.runtime.stack_file import stock
from endo3d.services.sequencer import Sequencer
from endo3d_core import patterns
from endo3d_core.calibration import Rig
from endo3d_core.head import Head
from endo3d_core.virtual_rig import scene
from endo3d_core.virtual_rig.effects import FAST
from endo3d_core.virtual_rig.renderer import Renderer

HEAD = str(stock("heads")["base6_wd20"])
SCENE = "contour texture=noise:0.15:0.15"
SLOW_MOTION = 4.0


@dataclass
class Stack:
    """Sequencer and grabber without a bus: modes go over at once, as the runner's turns would have it."""

    sequencer: Sequencer
    grabber: Grabber
    frames: list[Frame] = field(default_factory=list)
    truths: list[Truth] = field(default_factory=list)
    modes: list[Mode] = field(default_factory=list)
    calibrations: list[Message] = field(default_factory=list)

    def command(self, verb: str, **parameters: object) -> dict[str, object]:
        reply: dict[str, object] = {}
        for out in self.sequencer.command(verb, parameters, time.time_ns()):
            if isinstance(out, Mode):
                self.modes.append(out)
                list(self.grabber.step(out))
            else:
                reply.update(out)  # type: ignore[arg-type]
        return reply

    def until(self, frames: int, within_s: float = 120.0) -> None:
        """Run until so many frames have come in all."""
        deadline_s = time.monotonic() + within_s
        while len(self.frames) < frames and time.monotonic() < deadline_s:
            for out in self.sequencer.poll(0.0):
                assert isinstance(out, Mode)
                self.modes.append(out)
                list(self.grabber.step(out))
            for out in self.grabber.poll(0.02):
                if isinstance(out, Frame):
                    self.frames.append(out)
                elif isinstance(out, Truth):
                    self.truths.append(out)
                else:
                    self.calibrations.append(out)
        assert len(self.frames) >= frames, "the frames did not come in time"


@pytest.fixture
def stack(tmp_path: Path) -> Iterator[Stack]:
    bench = tmp_path / "bench"
    sequencer = Sequencer(
        Sequencer.Config.model_validate({"projector": f"sim:?bench={bench}", "head": HEAD, "rate_hz": 25.0})
    )
    uri = f"sim:{SCENE}?motion=hand seed=7&bin=4&slow_motion={SLOW_MOTION}&bench={bench}"
    grabber = Grabber(Grabber.Config.model_validate({"camera": uri, "head": HEAD}))
    # The camera may come first: it waits for the light.
    grabber.open()
    sequencer.open()
    yield Stack(sequencer, grabber)
    grabber.close()
    sequencer.close()


def true_slot(frame: Frame, truth: Truth, renderer: Renderer) -> int:
    """The slot whose pattern explains the image best, at the pose the truth tells."""
    shape = frame.image.shape
    scores = []
    for pattern in patterns.parse(frame.pattern_set).patterns:
        expected = np.zeros(shape[0] * shape[1], np.float32)
        light = renderer.light(patterns.image(pattern, 960, 960))
        expected[renderer.where] = renderer.exposure(light, [truth.T_scene_camera])
        scores.append(np.corrcoef(expected, frame.image.ravel())[0, 1])
    assert max(scores) > 0.98
    return int(np.argmax(scores))


def test_labels_say_what_the_frames_show(stack: Stack) -> None:
    """Through a mode switch, a pattern set by its text and a stop: slot, set, epoch, pose and stamp are right."""
    yaml = Path(HEAD).read_text()
    renderer = Renderer(Rig.from_yaml(yaml), Head.from_yaml(yaml), scene.parse(SCENE), FAST, bin_px=4)
    stack.until(6)
    switched = stack.command("mode", mode="conventional")
    stack.until(16)
    stack.command("mode", mode="interleaved f1=15")
    stack.until(22)
    epochs = list(dict.fromkeys(frame.epoch for frame in stack.frames))
    assert len(epochs) == 3
    assert epochs == sorted(epochs)
    assert switched["pattern_set"] == "conventional f=50/49/43 steps=4/2/2"
    by_epoch = {mode.epoch: mode for mode in stack.modes if mode.running}
    for frame, truth in zip(stack.frames, stack.truths, strict=True):
        mode = by_epoch[frame.epoch]
        assert frame.pattern_set == mode.pattern_set
        assert frame.slot == true_slot(frame, truth, renderer)
        assert truth.sequence == frame.sequence
        assert truth.scene == SCENE
        assert truth.slow_motion == SLOW_MOTION
        count = round((frame.trigger_ns - mode.start_ns) / mode.frame_period_ns)
        assert frame.slot == count % len(patterns.parse(frame.pattern_set))
        assert frame.stamp_ns - frame.trigger_ns == round(frame.exposure_us * 500)
    sequences = [frame.sequence for frame in stack.frames]
    assert sequences == sorted(set(sequences))
    missed = stack.grabber.losses()["trigger:missed"]
    assert sequences[-1] - sequences[0] + 1 == len(sequences) + missed


def test_the_calibration_comes_first_and_fits_the_images(stack: Stack) -> None:
    stack.until(1)
    camera, projector = stack.calibrations
    assert isinstance(camera, CameraCalibration)
    assert isinstance(projector, ProjectorCalibration)
    assert (camera.height, camera.width) == stack.frames[0].image.shape
    assert projector.yaml == Path(HEAD).read_text()


def test_a_stopped_projector_gives_no_frames_and_starts_anew_at_slot_0(stack: Stack) -> None:
    stack.until(3)
    assert stack.command("stop")["running"] is False
    stack.until(3)
    for _ in range(30):
        list(stack.grabber.poll(0.01))
    assert not list(stack.grabber.poll(0.02))
    before = len(stack.frames)
    stack.command("start")
    stack.until(before + 2)
    first = next(f for f in stack.frames if f.epoch == stack.modes[-1].epoch)
    assert first.slot in (0, 1)  # one trigger may be missed while the camera takes the new light over
    assert stack.modes[-1].running


def test_an_exposure_takes_effect_with_the_next_epoch(stack: Stack) -> None:
    stack.until(2)
    reply = stack.command("exposure", exposure_us=60_000.0)
    assert reply["exposure_us"] == 60_000.0
    stack.until(len(stack.frames) + 3)
    longer, shorter = stack.frames[-1], stack.frames[0]
    assert longer.exposure_us == 60_000.0
    ratio = np.float64(longer.image.mean()) / shorter.image.mean()
    assert ratio == pytest.approx(60_000.0 / shorter.exposure_us, rel=0.15)


@pytest.mark.parametrize(
    ("verb", "parameters", "hint"),
    [
        ("mode", {"mode": "stripes"}, "no mode .*interleaved"),
        ("exposure", {"exposure_us": 10.0}, "at least"),
        ("exposure", {"exposure_us": "long"}, "no exposure"),
        ("zoom", {}, "mode, exposure, start, stop"),
    ],
)
def test_a_wrong_command_is_refused_and_nothing_changes(
    stack: Stack, verb: str, parameters: dict[str, object], hint: str
) -> None:
    stack.until(1)
    with pytest.raises(Refused, match=hint):
        stack.command(verb, **parameters)
    stack.until(len(stack.frames) + 3)
    assert {frame.epoch for frame in stack.frames} == {stack.modes[0].epoch}


@pytest.mark.parametrize(
    ("camera", "hint"),
    [
        ("sim:contur", "unknown scene"),
        ("sim:?motion=walk", "unknown motion"),
        ("sim:?slowmotion=2", "did you mean 'slow_motion'"),
        ("sim:?preset=best", "fast"),
        ("sim:?bin=half", "not a number"),
        ("sim", "no scheme"),
        ("simulated:", "no camera driver"),
    ],
)
def test_a_wrong_camera_gets_one_line(setting: Setting, camera: str, hint: str) -> None:
    grabber = Grabber(Grabber.Config.model_validate({"camera": camera, "head": HEAD}))
    with pytest.raises(UserError, match=hint):
        grabber.open()
    grabber.close()


def test_a_missing_head_gets_one_line() -> None:
    for service in (
        Grabber(Grabber.Config.model_validate({"head": "/nowhere.yaml"})),
        Sequencer(Sequencer.Config.model_validate({"head": "/nowhere.yaml"})),
    ):
        with pytest.raises(UserError, match="deploy/heads"):
            service.open()
