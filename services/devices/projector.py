"""What a projector is to the stack."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from endo3d.services.devices.uri import Setting, open_device
from endo3d_core.patterns import PatternSet

DRIVERS = ("sim", "dlpc900", "dlpc350", "alp", "screen")


@dataclass(frozen=True, slots=True)
class Limits:
    """Read from the device, not assumed."""

    min_exposure_us: float
    """Of an 8-bit pattern."""
    min_dark_us: float
    """Between two patterns."""


@dataclass(frozen=True, slots=True)
class ProjectorStatus:
    connected: bool
    running: bool
    note: str = ""
    """For people: what is wrong and what to do."""


class Projector(Protocol):
    """Holds all pattern sets at once; starting another one needs no upload. Calls come from one thread."""

    @property
    def limits(self) -> Limits: ...

    def load(self, sets: Sequence[PatternSet]) -> None:
        """Upload every pattern of every set, replacing what was there; the projector is stopped."""

    def start(self, pattern_set: PatternSet, exposure_us: float, dark_us: float) -> int:
        """Show a loaded set from slot 0 on, for ever. Returns when slot 0 starts, ns of the rig's clock.

        Patterns with an exposure of their own keep it. Raises ``DeviceError`` when a limit is broken.
        """

    def stop(self) -> None:
        """No light, no triggers."""

    def status(self) -> ProjectorStatus:
        """Cheap enough to be asked a few times a second."""

    def now_ns(self) -> int:
        """The rig's clock."""

    def close(self) -> None:
        """Stop and let go."""


def open_projector(uri: str, setting: Setting) -> Projector:
    """Open by URI. Raises ``DeviceError`` with what to do."""
    projector: Projector = open_device(uri, "projector", DRIVERS, setting)
    return projector
