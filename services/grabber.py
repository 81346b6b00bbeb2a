"""Camera to frames: every shot gets its sequence number, slot and pattern set, and travels in place."""

from __future__ import annotations

import logging
import time
from collections import Counter, deque
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import ClassVar

from pydantic import Field

from endo3d.schemas import topics
from endo3d.schemas.messages import CameraCalibration, Frame, Message, Mode, ProjectorCalibration, Truth
from endo3d.services.devices.camera import Camera, Shot, Simulated, open_camera
from endo3d.services.devices.labels import Label, Labels
from endo3d.services.devices.uri import DeviceError, Setting
from endo3d.services.runtime import service
from endo3d.services.runtime.errors import UserError
from endo3d.services.runtime.service import Exhausted, Source
from endo3d_core.calibrating.quality import Quality
from endo3d_core.calibration import Lens, Rig

log = logging.getLogger(__name__)

TURN_S = 0.004
REOPEN_NS = 1_000_000_000
"""How often a camera that is gone is looked for."""
SILENCE_NS, SILENCE_PERIODS = 1_000_000_000, 10
"""A camera that gives no image for so long, while the projector runs, is reported."""
HELD = 2
"""Shots that wait for their mode to be announced."""


class GrabberConfig(service.Config):
    camera: str = "sim:"
    """The device's URI."""
    rig: str = "demo"
    head: str = ""
    """The calibration: path of the sensor head's YAML."""
    lend_ahead: int = Field(2, ge=1, le=16)
    """Frames of shared memory that the camera holds in advance."""


class Grabber(Source[GrabberConfig]):
    Config = GrabberConfig
    reads = (topics.MODE,)
    writes = (topics.FRAME, topics.CAMERA, topics.PROJECTOR, topics.TRUTH)
    optional: ClassVar = (topics.MODE,)

    def __init__(self, config: GrabberConfig) -> None:
        super().__init__(config)
        self._camera: Camera | None = None
        self.labels = Labels()
        self.held: deque[Shot] = deque()
        self.lent = 0
        self.announced = False
        self.quality = Quality("design")
        self.exposure_us: float | None = None
        self.note = ""
        self.gone = 0
        """How often the camera was lost."""
        self.look_ns = 0
        self.patience_ns = SILENCE_NS
        self.image_due_ns: int | None = None
        """None while the projector does not run."""
        self.lost_before: Mapping[str, int] = {}
        """By cameras that are gone."""

    @property
    def camera(self) -> Camera:
        if self._camera is None:
            raise RuntimeError("the grabber has not been opened")
        return self._camera

    def open(self) -> None:
        try:
            self.yaml = Path(self.config.head).read_text(encoding="utf-8")
            self.connect()
            self.quality = Quality.from_yaml(self.yaml)
        except OSError as error:
            raise UserError(f"head {self.config.head!r}: {error.strerror}; name a file of deploy/heads") from error
        except (DeviceError, ValueError) as error:
            raise UserError(str(error)) from error

    def connect(self) -> None:
        camera = open_camera(self.config.camera, Setting(self.config.rig, self.yaml))
        try:
            if self.exposure_us is not None:
                camera.set_exposure(self.exposure_us)
            camera.arm()
        except DeviceError:
            camera.close()
            raise
        self._camera, self.lent, self.note = camera, 0, ""

    def step(self, message: Message) -> Iterator[Message]:
        if isinstance(message, Mode):
            self.labels.add(message)
            self.patience_ns = max(SILENCE_NS, SILENCE_PERIODS * message.frame_period_ns)
            self.image_due_ns = message.start_ns + self.patience_ns if message.running else None
            if message.running:
                self.exposure_us = message.exposure_us
                if self._camera is not None:
                    self._camera.set_exposure(message.exposure_us)
        yield from ()

    def poll(self, timeout_s: float) -> Iterator[Message]:
        if not self.announced:
            self.announced = True
            # On the bus, so that every log that is made with this calibration names its state.
            log.log(logging.WARNING if self.quality.state == "bad" else logging.INFO, self.quality.line)
            yield from self.calibration()
        if self._camera is None:
            self.look_for_camera(timeout_s)
            return
        self.lend()
        # In short turns: a mode that is announced meanwhile must be known before its first shot is labelled.
        try:
            shot = self.camera.wait(min(timeout_s, TURN_S))
        except DeviceError as error:
            self.lose_camera(error)
            return
        if shot is not None:
            self.lent -= 1
            self.held.append(shot)
            if self.image_due_ns is not None:
                self.image_due_ns = self.camera.now_ns() + self.patience_ns
        while self.held and (label := self.labels.of(self.held[0].trigger_ns)) is not None:
            yield from self.labelled(self.held.popleft(), label)
        if len(self.held) > HELD:
            self.held.popleft()
            self.labels.losses["shot:unlabelled"] += 1

    def lose_camera(self, error: DeviceError) -> None:
        """It was unplugged: say so, and look for it from now on."""
        self.note = str(error)
        self.gone += 1
        self.lost_before = Counter(self.lost_before) + Counter(self.camera.losses())
        self.camera.close()
        self._camera = None

    def look_for_camera(self, timeout_s: float) -> None:
        if time.monotonic_ns() < self.look_ns:
            time.sleep(timeout_s)
            return
        try:
            self.connect()
        except DeviceError as error:
            self.note = str(error)
        self.look_ns = time.monotonic_ns() + REOPEN_NS

    def trouble(self) -> str:
        camera, due_ns = self._camera, self.image_due_ns
        if camera is not None and due_ns is not None and (late_ns := camera.now_ns() - due_ns) > 0:
            silent_s = 1e-9 * (late_ns + self.patience_ns)
            return f"no image for {silent_s:.0f} s though the projector runs; check the trigger's cable, the lens cap"
        return self.note or (self.quality.line if self.quality.state == "bad" else "")

    def values(self) -> Mapping[str, float]:
        return {"camera_lost": float(self.gone)}

    def lend(self) -> None:
        """Keep the camera supplied; when the readers hold everything, the camera counts what it loses."""
        while self.lent < self.config.lend_ahead:
            try:
                image = self.loan(topics.FRAME, self.camera.shape, self.camera.dtype)
            except Exhausted:
                return
            self.camera.lend(image)
            self.lent += 1

    def labelled(self, shot: Shot, label: Label) -> Iterator[Message]:
        """The frame, and its truth when the camera knows it."""
        stamp_ns = shot.trigger_ns + round(shot.exposure_us * 500)
        yield Frame(
            stamp_ns, label.sequence, shot.image, label.pattern_set, label.slot, label.epoch,
            shot.exposure_us, shot.trigger_ns, shot.frame_id,
        )  # fmt: skip
        if isinstance(self.camera, Simulated):
            camera = self.camera
            yield Truth(stamp_ns, label.sequence, camera.T_scene_camera(stamp_ns), camera.scene, camera.slow_motion)

    def calibration(self) -> Iterator[Message]:
        """What the frames were taken with; the camera's lens as it is binned and cut to a region."""
        rig, now_ns = Rig.from_yaml(self.yaml), self.camera.now_ns()
        height, width = self.camera.shape
        binned = rig.camera.binned(self.camera.bin_px or max(1, round(rig.camera.width / width)))
        K = binned.K.copy()
        K[:2, 2] -= self.camera.corner
        lens, projector = Lens(width, height, K, binned.dist), rig.projector
        yield CameraCalibration(now_ns, lens.width, lens.height, lens.K, lens.dist)
        yield ProjectorCalibration(
            now_ns,
            projector.width,
            projector.height,
            projector.K,
            projector.dist,
            rig.T_projector_camera,
            self.yaml,
        )

    def losses(self) -> Mapping[str, int]:
        of_camera = Counter(self.lost_before) + Counter(self._camera.losses() if self._camera else {})
        return {**self.labels.losses, **{f"camera:{cause}": count for cause, count in of_camera.items()}}

    def close(self) -> None:
        if self._camera is not None:
            self._camera.close()
