"""What a service is: typed inputs, a pure step, outputs.

A step has no clock, no transport and no thread: time arrives in the messages. The same class runs live,
in replay and in tests, so a replay is bit-exact.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray
from pydantic import BaseModel, ConfigDict

from endo3d.schemas.messages import Message
from endo3d.schemas.topics import Topic

if TYPE_CHECKING:
    from endo3d.services.runtime.bus import Bus


class Config(BaseModel):
    """A service's table in the stack file. Unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True)


C = TypeVar("C", bound=Config)


class Loan(Protocol):
    """Lends an array that the runtime owns, so that publishing it copies nothing."""

    def __call__(self, topic: Topic, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """An uninitialised array; raises ``Exhausted`` when every slot is still being read."""


class Exhausted(Exception):
    """No free shared memory: the message is dropped and counted."""


class Refused(Exception):
    """A command that can't be carried out; its text says why and what to do."""


def _always() -> bool:
    return True


@dataclass(frozen=True, slots=True)
class Sample:
    """What travelled, still encoded: what a ``Tap`` takes."""

    topic: Topic
    source: str
    """The service that wrote it, for topics written per service; else empty."""
    payload: memoryview
    """The encoded message, bytes; valid during the call only."""
    received_ns: int
    """When it arrived here."""
    valid: Callable[[], bool] = _always
    """To ask AFTER copying: False when the writer's memory was reclaimed meanwhile (drop it, count it)."""


def plain_loan(topic: Topic, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """Ordinary memory: replay and tests."""
    return np.empty(shape, dtype)


class Service(Generic[C]):
    """Inputs, step, outputs. Wiring is derived from ``reads`` and ``writes``."""

    Config: ClassVar[type[Config]] = Config
    reads: ClassVar[tuple[Topic, ...]] = ()
    optional: ClassVar[tuple[Topic, ...]] = ()
    """Those of ``reads`` that need no writer in the stack."""
    newest: ClassVar[tuple[Topic, ...]] = ()
    """Those of ``reads`` of which only the newest sample is wanted: older ones are skipped, which is no loss."""
    writes: ClassVar[tuple[Topic, ...]] = ()
    commands: ClassVar[tuple[str, ...]] = ()
    """The verbs ``command`` understands."""

    nice: ClassVar[int] = 0
    """Its process yields the processor to the others by this much: for services that only look on."""

    def __init__(self, config: C) -> None:
        self.config = config
        self.loan: Loan = plain_loan

    def newest_hz(self, topic: Topic) -> float | None:
        """How many samples a second are looked at, the newest each time; None: every sample counts; 0: none."""
        return math.inf if topic in self.newest else None

    def open(self) -> None:
        """Take what has to be taken (a device, a file). Raises with what to do."""

    def warm(self) -> None:
        """Compile and touch everything a first step would otherwise wait for."""

    def step(self, message: Message) -> Iterator[Message]:
        """One message in, any number out."""
        return iter(())

    def void(self) -> None:
        """Forget what the last message brought: its memory was taken back while it was read."""

    def command(
        self, verb: str, parameters: Mapping[str, Any], now_ns: int
    ) -> Iterator[Message | Mapping[str, Any]]:
        """A command from the control plane: yields messages to publish and at most one mapping, the reply.

        Raises ``Refused`` with what to do.
        """
        raise Refused(f"no command {verb!r}; this service knows: {', '.join(self.commands) or 'none'}")

    def values(self) -> Mapping[str, float]:
        """The service's own figures for its status."""
        return {}

    def losses(self) -> Mapping[str, int]:
        """Messages the service itself lost since start, per cause; the runner adds them to the status' drops."""
        return {}

    def trouble(self) -> str:
        """One line for people, what is wrong and what to do, while it is: the status is then DEGRADED."""
        return ""

    def close(self) -> None:
        """Give everything back; called once, also after a failure."""


class Source(Service[C]):
    """A service that produces by itself: a camera, a player. ``poll`` replaces an input."""

    def poll(self, timeout_s: float) -> Iterator[Message]:
        """Wait at most ``timeout_s`` for the outside world and yield what came."""
        return iter(())

    finished: bool = False
    """Nothing more will come."""


class Tap(Service[C]):
    """A service that takes what travels undecoded: the recorder, a relay. ``take`` is called instead of ``step``."""

    def take(self, sample: Sample) -> Iterator[Message]:
        """One sample in; what has to outlive the call is copied, then ``sample.valid()`` is asked."""
        return iter(())


class Gateway(Service[C]):
    """A service at the edge of the bus: it carries what others say, so it gets the bus itself."""

    def connect(self, bus: Bus) -> None:
        """Called once, when the service is open; from then on its threads may use the bus until ``close``."""
