"""Owns the pattern sequence and the mode: commands the projector, says what it shows from when on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from time import sleep
from typing import Any, ClassVar

from pydantic import Field

from endo3d.schemas import topics
from endo3d.schemas.messages import Message, Mode
from endo3d.services.devices.projector import Projector, open_projector
from endo3d.services.devices.uri import DeviceError, Setting
from endo3d.services.runtime import service
from endo3d.services.runtime.errors import UserError
from endo3d.services.runtime.service import Refused, Source
from endo3d_core import patterns
from endo3d_core.patterns import PatternSet

LOOK_NS = 300_000_000
"""How often the projector is asked how it does, and a lost one looked for."""


class SequencerConfig(service.Config):
    projector: str = "sim:"
    """The device's URI."""
    rig: str = "demo"
    head: str = ""
    """Path of the sensor head's YAML."""
    modes: Mapping[str, str] = {
        "interleaved": "interleaved f1=25",
        "conventional": "conventional f=50/49/43 steps=4/2/2",
    }
    """Names for pattern sets; all are loaded at the start, so that a switch needs no upload."""
    mode: str = "interleaved"
    """What is shown at the start."""
    rate_hz: float = Field(132.0, gt=0)
    """Patterns per second, exposure and dark time together."""
    dark_us: float = Field(105.0, ge=0)
    """Between two patterns: the DLPC900 needs 105."""
    autostart: bool = True


class Sequencer(Source[SequencerConfig]):
    Config = SequencerConfig
    writes = (topics.MODE,)
    commands: ClassVar = ("mode", "exposure", "start", "stop")

    def __init__(self, config: SequencerConfig) -> None:
        super().__init__(config)
        self._projector: Projector | None = None
        self.note = ""
        self.resumed = 0
        """Starts after the projector had stopped by itself."""
        self.look_ns = 0

    @property
    def projector(self) -> Projector:
        if self._projector is None:
            raise RuntimeError("the sequencer has not been opened")
        return self._projector

    def open(self) -> None:
        try:
            yaml = Path(self.config.head).read_text(encoding="utf-8")
            self.sets = {name: patterns.parse(text) for name, text in self.config.modes.items()}
            self._projector = open_projector(self.config.projector, Setting(self.config.rig, yaml))
        except OSError as error:
            raise UserError(f"head {self.config.head!r}: {error.strerror}; name a file of deploy/heads") from error
        except (DeviceError, ValueError) as error:
            raise UserError(str(error)) from error
        if self.config.mode not in self.sets:
            raise UserError(f"mode {self.config.mode!r} is none of sequencer.modes: {', '.join(self.sets)}")
        self.mode = self.config.mode
        # Projectors count whole microseconds.
        self.exposure_us = float(round(1e6 / self.config.rate_hz - self.config.dark_us))
        # Seconds at the start, one more per start: a restarted sequencer doesn't repeat an epoch.
        self.epoch = self.projector.now_ns() // 1_000_000_000
        self.wanted = self.config.autostart
        self.shown: Mode | None = None
        try:
            self.projector.load(list(self.sets.values()))
        except DeviceError as error:
            raise UserError(str(error)) from error

    def poll(self, timeout_s: float) -> Iterator[Message]:
        if self.wanted and self.projector.now_ns() >= self.look_ns:
            self.look_ns = self.projector.now_ns() + LOOK_NS
            yield from self.tend()
        else:
            sleep(timeout_s)

    def tend(self) -> Iterator[Message]:
        """Start what is wanted and doesn't run: at first, and after the projector was gone."""
        if self.shown is not None and self.shown.running:
            status = self.projector.status()
            self.note = status.note
            if status.running:
                return
            self.resumed += 1
            yield self.say(self.projector.now_ns(), running=False)
        try:
            yield self.start()
        except DeviceError as error:
            self.note = str(error)
        else:
            self.note = ""

    def trouble(self) -> str:
        return self.note

    def values(self) -> Mapping[str, float]:
        return {"resumed": float(self.resumed)}

    def command(self, verb: str, parameters: Mapping[str, Any], now_ns: int) -> Iterator[Message | Mapping[str, Any]]:
        before = self.mode, self.exposure_us
        try:
            match verb:
                case "mode":
                    self.mode = self.named(str(parameters.get("mode", "")))
                case "exposure":
                    self.exposure_us = self.exposure(parameters.get("exposure_us"))
                case "start":
                    pass
                case "stop":
                    self.wanted = False
                    yield self.stop()
                    yield {"running": False}
                    return
                case _:
                    yield from super().command(verb, parameters, now_ns)
                    return
            # First the end of the old mode: no shot of the new one may be taken for one of the old.
            yield self.stop()
            mode = self.start()
        except (DeviceError, ValueError) as error:
            self.mode, self.exposure_us = before  # which goes on as soon as the projector can
            raise Refused(str(error)) from error
        yield mode
        yield {
            "mode": mode.mode, "pattern_set": mode.pattern_set, "epoch": mode.epoch,
            "start_ns": mode.start_ns, "exposure_us": mode.exposure_us, "running": True,
        }  # fmt: skip

    def named(self, name: str) -> str:
        """The mode of that name, or the pattern set that the text describes, loaded beside the others."""
        if name in self.sets:
            return name
        try:
            pattern_set = patterns.parse(name)
        except ValueError as error:
            raise ValueError(f"{name!r} is no mode ({', '.join(self.sets)}) and no pattern set: {error}") from error
        for known, loaded in self.sets.items():
            if loaded.text == pattern_set.text:
                return known
        self.projector.stop()
        self.projector.load([*self.sets.values(), pattern_set])
        self.sets[pattern_set.text] = pattern_set
        return pattern_set.text

    def exposure(self, value: object) -> float:
        """A wanted exposure, checked against the projector's limits."""
        shortest = self.projector.limits.min_exposure_us
        if not isinstance(value, int | float) or not value >= shortest:
            raise ValueError(f"exposure_us={value} is no exposure; the projector needs {shortest:g} us at least")
        return float(value)

    @property
    def pattern_set(self) -> PatternSet:
        return self.sets[self.mode]

    def start(self) -> Mode:
        """Start the projector at slot 0 and say so."""
        start_ns = self.projector.start(self.pattern_set, self.exposure_us, self.config.dark_us)
        self.epoch += 1
        self.wanted = True
        return self.say(start_ns, running=True)

    def stop(self) -> Mode:
        """Stop the projector and say so."""
        self.projector.stop()
        return self.say(self.projector.now_ns(), running=False)

    def say(self, start_ns: int, *, running: bool) -> Mode:
        period_ns = round((self.exposure_us + self.config.dark_us) * 1e3)
        self.shown = Mode(
            self.projector.now_ns(), self.mode, self.pattern_set.text, self.epoch, start_ns, period_ns,
            self.exposure_us, running,
        )  # fmt: skip
        return self.shown

    def close(self) -> None:
        if self._projector is not None:
            self._projector.close()
