"""Which pattern a camera's shot shows, from time stamps and what the sequencer said."""

from __future__ import annotations

from dataclasses import dataclass

from endo3d.schemas.messages import Mode
from endo3d.services.devices.slots import timeline
from endo3d_core.slot_identity import UNKNOWN, SlotClock


@dataclass(frozen=True, slots=True)
class Label:
    sequence: int
    slot: int
    epoch: int
    pattern_set: str


@dataclass(slots=True)
class _Run:
    """One start of the projector."""

    mode: Mode
    clock: SlotClock
    end_ns: int | None = None


class Labels:
    """Labels shots in the order of their exposure."""

    def __init__(self) -> None:
        self._runs: list[_Run] = []
        self._sequence = -1
        self.losses = {"trigger:missed": 0, "shot:unlabelled": 0, "shot:off beat": 0, "beat:taken anew": 0}

    def add(self, mode: Mode) -> None:
        """A mode that begins, or (not running) the end of one. Repeated announcements change nothing."""
        if not mode.running:
            if self._runs and self._runs[-1].end_ns is None and self._runs[-1].mode.start_ns < mode.start_ns:
                self._runs[-1].end_ns = mode.start_ns
        elif not any(run.mode.epoch == mode.epoch for run in self._runs):
            dark_us = mode.frame_period_ns * 1e-3 - mode.exposure_us
            shown = timeline(mode.pattern_set, mode.start_ns, mode.exposure_us, dark_us)
            self._runs = [*self._runs[-1:], _Run(mode, SlotClock(shown))]

    def of(self, trigger_ns: int) -> Label | None:
        """The label of the shot whose exposure began then; None when no mode that was announced covers it."""
        run = self._covering(trigger_ns)
        if run is None:
            return None
        reanchored = run.clock.reanchored
        placed = run.clock.place(trigger_ns)
        self.losses["beat:taken anew"] += run.clock.reanchored - reanchored
        self.losses["shot:off beat"] += placed.slot == UNKNOWN
        self.losses["trigger:missed"] += placed.missed
        # A grabber that was restarted goes on at the pattern that is shown: no (epoch, sequence) comes twice.
        self._sequence = self._sequence + placed.missed + 1 if self._sequence >= 0 else max(0, placed.count)
        return Label(self._sequence, placed.slot, run.mode.epoch, run.mode.pattern_set)

    def _covering(self, trigger_ns: int) -> _Run | None:
        for index in reversed(range(len(self._runs))):
            run = self._runs[index]
            # It says to half a period when it started; nothing from before the last stop is its own.
            early_ns = run.mode.start_ns - run.mode.frame_period_ns // 2
            ended_ns = self._runs[index - 1].end_ns if index else None
            if trigger_ns >= max(early_ns, ended_ns or early_ns):
                exposure_ns = run.mode.exposure_us * 1e3
                whole = run.end_ns is None or trigger_ns + exposure_ns <= run.end_ns
                return run if whole else None
        return None
