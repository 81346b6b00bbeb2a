"""Stand-in services for the runner's tests, and a process that runs one of them."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from endo3d.schemas import topics
from endo3d.schemas.messages import DepthMap, Frame, Message, Mode
from endo3d.services.runtime.service import Config, Refused, Sample, Service, Source, Tap


class Ticker(Source[Config]):
    """A camera: a frame every ``period_s``; knows ``count`` and ``mode``."""

    writes = (topics.FRAME, topics.MODE)
    commands = ("count", "mode")
    period_s = 0.005
    limit = 1_000_000

    def open(self) -> None:
        self.count = 0

    def poll(self, timeout_s: float) -> Iterator[Message]:
        time.sleep(min(self.period_s, timeout_s))  # the wait for the shutter
        image = self.loan(topics.FRAME, (24, 32), np.uint8)
        image[:] = self.count % 251
        yield Frame(time.time_ns(), self.count, image, "interleaved f1=25", 0, 1, 2900.0, 0, self.count)
        self.count += 1
        self.finished = self.count >= self.limit

    def command(self, verb: str, parameters: Mapping[str, Any], now_ns: int) -> Iterator[Message | Mapping[str, Any]]:
        match verb:
            case "count":
                yield {"count": self.count}
            case "mode" if "name" not in parameters:
                raise Refused("say which: name=...")
            case "mode":
                yield Mode(now_ns, parameters["name"], "interleaved f1=25", 1, 0, 5_555_556, 2900.0, True)
                yield {"epoch": 1}
            case _:
                yield from super().command(verb, parameters, now_ns)


class Halver(Service[Config]):
    """A decoder: every second pixel as a depth map. Fails on frames whose sequence is in ``bad``."""

    reads = (topics.FRAME,)
    writes = (topics.DEPTH,)
    bad: frozenset[int] = frozenset()

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self.closed = 0

    def step(self, message: Message) -> Iterator[Message]:
        assert isinstance(message, Frame)
        if message.sequence in self.bad:
            raise ValueError(f"frame {message.sequence} is bad")
        depth = self.loan(topics.DEPTH, (12, 16), np.uint16)
        depth[:] = message.image[::2, ::2]
        yield DepthMap(message.stamp_ns, message.sequence, depth, 0.001, 0.0, 2.0)

    def values(self) -> Mapping[str, float]:
        return {"answer": 42.0}

    def losses(self) -> Mapping[str, int]:
        return {"depth:clipped": 3}

    def close(self) -> None:
        self.closed += 1


class Keeper(Tap[Config]):
    """A recorder: keeps copies of what travels."""

    reads = (topics.FRAME, topics.LOG)

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self.kept: list[tuple[str, str, bytes, bool]] = []

    def take(self, sample: Sample) -> Iterator[Message]:
        copy = bytes(sample.payload)
        self.kept.append((sample.topic.name, sample.source, copy, sample.valid()))
        return iter(())
