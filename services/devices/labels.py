"""Which pattern a camera's shot shows, from time stamps and what the sequencer said.

A camera drops a trigger that comes too early without a trace in its frame ids, so only its time stamps tell:
the count advances by the rounded number of periods, and a stamp that fits no slot has no known slot.
"""

from __future__ import annotations

from dataclasses import dataclass

from endo3d.schemas.messages import Mode
from endo3d.services.devices.slots import Timeline, timeline

TOLERANCE = 0.25
"""Of a period."""
UNKNOWN = -1


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
    timeline: Timeline
    end_ns: int | None = None
    drift_ns: int = 0
    """The camera's clock against the projector's, followed from frame to frame."""
    count: int = -1


class Labels:
    """Labels shots in the order of their exposure."""

    def __init__(self) -> None:
        self._runs: list[_Run] = []
        self._sequence = -1
        self.losses = {"trigger:missed": 0, "shot:unlabelled": 0, "shot:off beat": 0}

    def add(self, mode: Mode) -> None:
        """A mode that begins, or (not running) the end of one. Repeated announcements change nothing."""
        if not mode.running:
            if self._runs and self._runs[-1].end_ns is None and self._runs[-1].mode.start_ns < mode.start_ns:
                self._runs[-1].end_ns = mode.start_ns
        elif not any(run.mode.epoch == mode.epoch for run in self._runs):
            dark_us = mode.frame_period_ns * 1e-3 - mode.exposure_us
            run = _Run(mode, timeline(mode.pattern_set, mode.start_ns, mode.exposure_us, dark_us))
            self._runs = [*self._runs[-1:], run]

    def of(self, trigger_ns: int) -> Label | None:
        """The label of the shot whose exposure began then; None when no mode that was announced covers it."""
        run = self._covering(trigger_ns)
        if run is None:
            return None
        count, late_ns, period_ns = run.timeline.nearest(trigger_ns - run.drift_ns)
        slot = count % run.timeline.slots
        if abs(late_ns) > TOLERANCE * period_ns:
            self.losses["shot:off beat"] += 1
            slot = UNKNOWN
        else:
            run.drift_ns += late_ns
        step = max(1, count - run.count) if run.count >= 0 else 1
        self.losses["trigger:missed"] += step - 1
        run.count = count
        self._sequence += step
        return Label(self._sequence, slot, run.mode.epoch, run.mode.pattern_set)

    def _covering(self, trigger_ns: int) -> _Run | None:
        for run in reversed(self._runs):
            early_ns = TOLERANCE * run.mode.frame_period_ns
            if trigger_ns >= run.mode.start_ns - early_ns:
                exposure_ns = run.mode.exposure_us * 1e3
                whole = run.end_ns is None or trigger_ns + exposure_ns <= run.end_ns
                return run if whole else None
        return None
