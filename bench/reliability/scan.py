"""A scan on the virtual rig that goes on while somebody breaks things, and what its launcher says meanwhile."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Self

from bench.reliability.witness import Witness
from endo3d.services.runtime import stack_file
from endo3d.services.runtime.bus import Bus
from endo3d.services.runtime.launcher import Child, Launcher, children_of

START_LIMIT_S = 300.0
"""The first start on a machine compiles every kernel."""


class Hung(Exception):
    """Something that had to happen did not, in all the time it was given."""


class Scan:
    """A running stack with a witness. A context manager: nothing of it is left behind."""

    def __init__(self, stack: str, overrides: Sequence[str], environment: dict[str, str] | None = None) -> None:
        described = stack_file.load(stack, overrides)
        self.rig = described.rig.name
        self.services = tuple(described.tables)
        self.said: list[str] = []
        """What the launcher and the services said since ``listen``."""
        self.bus = Bus.open(self.rig, name="campaign")
        self.witness = Witness(self.bus)
        self.launcher = Launcher(children_of(described, overrides), self._hear, environment)

    def __enter__(self) -> Self:
        self.launcher.start()
        self.until(lambda: self.witness.all_well_after(1, self.services), START_LIMIT_S, "the first cloud and pose")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.launcher.stop()
        self.launcher.close()
        self.bus.close()

    def child(self, service: str) -> Child:
        return next(child for child in self.launcher.children if child.name == service)

    def turn_for(self, seconds: float) -> None:
        """Let the scan go on."""
        end_s = time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0:
            self.launcher.turn(min(left_s, 0.1))

    def until(self, condition: Callable[[], bool], limit_s: float, what: str) -> float:
        """Let it go on until ``condition``; the seconds that took. Raises ``Hung``."""
        began_s = time.monotonic()
        while not condition():
            if time.monotonic() - began_s > limit_s:
                raise Hung(f"{what}: not within {limit_s:g} s")
            self.launcher.turn(0.05)
        return time.monotonic() - began_s

    @staticmethod
    def now_ns() -> int:
        """The clock of the stamps."""
        return time.time_ns()

    def listen(self) -> None:
        """Forget what was said and seen so far."""
        self.said.clear()
        self.witness.take()

    def _hear(self, service: str, line: str) -> None:
        self.said.append(f"{service}: {line}")
