"""Transport: camera images of 1920 x 1200 at 180 Hz from one producer to three reader processes.

Three ways in one run: a raw ring in shared memory with a pipe to wake each reader (the limit), the bus, and
the bus over TCP loopback. Latency goes from the start of the copy into the slot (2.3 MB, in all three)
until the reader holds the image. The goals are the bus's: no drop in 60 s, a median of at most 1.6
times the ring's, and a producer of at most 15 % of a core.

    python -m bench.transport [--seconds 60] [--readers 3] [--json]
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from multiprocessing.shared_memory import SharedMemory

import numpy as np
from numpy.typing import NDArray

from endo3d.schemas import topics
from endo3d.schemas.messages import Frame, Message
from endo3d.services.runtime.bus import Bus
from endo3d.services.runtime.pool import SLOTS
from endo3d.services.runtime.service import Exhausted

HEIGHT, WIDTH, RATE_HZ = 1200, 1920, 180
FRAME_BYTES = HEIGHT * WIDTH
WARM_FRAMES = RATE_HZ
"""Sent first and not counted: pools get mapped, caches filled."""
PEER_SECONDS = 15.0
"""The most that the two ways beside the bus are given."""
IDLE_S = 3.0
GOAL_RATIO, GOAL_CPU = 1.6, 0.15

NOTE = struct.Struct("<qq")
"""What goes through the ring's pipes: sequence, stamp_ns."""
Send = Callable[[int, NDArray[np.uint8]], bool]
"""(sequence, image) -> whether there was a free slot for it."""


@dataclass(frozen=True)
class Reading:
    """What one reader saw."""

    received: int
    lost: int
    torn: int
    """Images that were overwritten while they were looked at."""
    p50_us: float
    p99_us: float
    max_us: float
    cpu_share: float


@dataclass(frozen=True)
class Result:
    """One way, measured."""

    way: str
    seconds: float
    sent: int
    exhausted: int
    producer_cpu_share: float
    readers: tuple[Reading, ...]

    @property
    def p50_us(self) -> float:
        return float(np.median([reader.p50_us for reader in self.readers]))

    @property
    def lost(self) -> int:
        return self.exhausted + sum(reader.lost + reader.torn for reader in self.readers)


class Taker:
    """Counts and times the images of one reader."""

    def __init__(self, total: int) -> None:
        self._latency_us = np.full(total, np.nan)
        self._torn = 0
        self._began_s = self._cpu_s = 0.0
        self._last_s = time.monotonic()
        self.end = threading.Event()

    def take(self, sequence: int, stamp_ns: int, image: NDArray[np.uint8]) -> None:
        """``image``: (1200, 1920), every pixel the sequence modulo 8."""
        latency_us = (time.time_ns() - stamp_ns) * 1e-3
        self._last_s = time.monotonic()
        if sequence < WARM_FRAMES:
            return
        if not self._began_s:
            self._began_s, self._cpu_s = time.monotonic(), time.process_time()
        index = sequence - WARM_FRAMES
        self._torn += not image[0, 0] == image[HEIGHT // 2, 7] == image[-1, -1] == sequence % 8
        self._latency_us[index] = latency_us
        if index == len(self._latency_us) - 1:
            self.end.set()

    def idle(self) -> bool:
        return bool(self._began_s) and time.monotonic() - self._last_s > IDLE_S

    def reading(self) -> Reading:
        known = self._latency_us[~np.isnan(self._latency_us)]
        p50, p99, most = np.percentile(known, (50, 99, 100)) if known.size else (np.nan,) * 3
        seconds = self._last_s - self._began_s
        return Reading(
            received=known.size,
            lost=len(self._latency_us) - known.size,
            torn=self._torn,
            p50_us=float(p50),
            p99_us=float(p99),
            max_us=float(most),
            cpu_share=(time.process_time() - self._cpu_s) / seconds if seconds > 0 else 0.0,
        )


# ---------------------------------------------------------------- the raw ring


def read_ring(control: Connection, total: int, memory_name: str, notes: Connection) -> None:
    memory = SharedMemory(memory_name, create=False)
    ring = np.ndarray((SLOTS, HEIGHT, WIDTH), np.uint8, memory.buf)
    taker = Taker(total)
    control.send("ready")
    while not taker.end.is_set() and (notes.poll(IDLE_S) or not taker.idle()):
        if notes.poll(0):
            sequence, stamp_ns = NOTE.unpack(notes.recv_bytes())
            taker.take(sequence, stamp_ns, ring[sequence % SLOTS])
    control.send(taker.reading())
    del ring
    memory.close()


@contextmanager
def ring_way(readers: int, total: int) -> Iterator[tuple[Send, list[Connection]]]:
    memory = SharedMemory(create=True, size=SLOTS * FRAME_BYTES)
    try:
        pipes = [multiprocessing.get_context("spawn").Pipe(duplex=False) for _ in range(readers)]
        controls = [start(read_ring, total, memory.name, receive) for receive, _ in pipes]
        for control in controls:
            control.recv()

        def send(sequence: int, image: NDArray[np.uint8]) -> bool:
            place = sequence % SLOTS * FRAME_BYTES
            slot = np.frombuffer(memory.buf, np.uint8, FRAME_BYTES, place).reshape(image.shape)
            stamp_ns = time.time_ns()
            slot[:] = image
            note = NOTE.pack(sequence, stamp_ns)
            for _, pipe in pipes:
                pipe.send_bytes(note)
            return True

        yield send, controls
    finally:
        memory.close()
        memory.unlink()


# ---------------------------------------------------------------- the bus


def read_bus(control: Connection, total: int, rig: str, name: str, shared_memory: bool) -> None:
    sys.setswitchinterval(5e-4)  # as the runner does
    taker = Taker(total)

    def take(message: Message) -> None:
        assert isinstance(message, Frame)
        taker.take(message.sequence, message.stamp_ns, message.image)

    with Bus.open(rig, name=name, shared_memory=shared_memory) as bus:
        bus.subscribe(topics.FRAME, take)
        bus.declare_alive()
        while not taker.end.wait(IDLE_S) and not taker.idle():
            pass
        control.send(taker.reading())


@contextmanager
def bus_way(readers: int, total: int, *, shared_memory: bool) -> Iterator[tuple[Send, list[Connection]]]:
    rig = f"bench-transport-{os.getpid()}-{shared_memory}"
    names = {f"reader{number}" for number in range(readers)}
    with Bus.open(rig, name="producer", shared_memory=shared_memory) as bus:
        waiting, all_there = set(names), threading.Event()

        def see(name: str, is_there: bool) -> None:
            waiting.discard(name)
            if not waiting:
                all_there.set()

        bus.watch_alive(see)
        controls = [start(read_bus, total, rig, name, shared_memory) for name in sorted(names)]
        if not all_there.wait(60):
            raise RuntimeError(f"no sign of {', '.join(sorted(waiting))}")

        def send(sequence: int, image: NDArray[np.uint8]) -> bool:
            try:
                slot = bus.loan(topics.FRAME, image.shape, image.dtype)
            except Exhausted:
                return False
            stamp_ns = time.time_ns()
            slot[:] = image
            bus.publish(Frame(stamp_ns, sequence, slot, "interleaved f1=25", sequence % 3, 1, 2900.0, 0, sequence))
            return True

        yield send, controls


# ---------------------------------------------------------------- the run


def start(work: Callable[..., None], *args: object) -> Connection:
    """Run ``work(pipe, *args)`` in a process of its own; the other end of the pipe."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    context.Process(target=work, args=(theirs, *args), daemon=True).start()
    theirs.close()
    return ours


def measure(way: str, readers: int, seconds: float) -> Result:
    total = round(seconds * RATE_HZ)
    images = [np.full((HEIGHT, WIDTH), number, np.uint8) for number in range(8)]
    with ExitStack() as stack:
        if way == "raw ring":
            send, controls = stack.enter_context(ring_way(readers, total))
        else:
            send, controls = stack.enter_context(bus_way(readers, total, shared_memory=way == "bus"))
        exhausted = 0
        began_s, cpu_s = time.monotonic(), 0.0
        for sequence in range(WARM_FRAMES + total):
            if sequence == WARM_FRAMES:
                cpu_s, exhausted = time.process_time(), 0
            time.sleep(max(0.0, began_s + sequence / RATE_HZ - time.monotonic()))
            exhausted += not send(sequence, images[sequence % 8])
        cpu_s = time.process_time() - cpu_s
        elapsed_s = time.monotonic() - began_s - WARM_FRAMES / RATE_HZ
        readings = tuple(control.recv() for control in controls)
    return Result(way, elapsed_s, total, exhausted, cpu_s / elapsed_s, readings)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--readers", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    beside_s = min(given.seconds, PEER_SECONDS)
    ring = measure("raw ring", given.readers, beside_s)
    bus = measure("bus", given.readers, given.seconds)
    tcp = measure("bus over TCP", given.readers, beside_s)
    ratio = bus.p50_us / ring.p50_us
    if given.json:
        print(json.dumps({"ratio": ratio, "ways": [asdict(way) for way in (ring, bus, tcp)]}, indent=2))
        return
    print(f"{WIDTH}x{HEIGHT} at {RATE_HZ} Hz, one producer, {given.readers} readers; latency in us, CPU of one core")
    print(f"{'way':<14}{'s':>6}{'sent':>8}{'lost':>7}{'p50':>9}{'p99':>9}{'max':>9}{'producer':>10}{'reader':>8}")
    for way in (ring, bus, tcp):
        p99, most, cpu = (
            max(getattr(reader, name) for reader in way.readers) for name in ("p99_us", "max_us", "cpu_share")
        )
        print(
            f"{way.way:<14}{way.seconds:>6.0f}{way.sent:>8}{way.lost:>7}{way.p50_us:>9.0f}{p99:>9.0f}{most:>9.0f}"
            f"{way.producer_cpu_share:>10.1%}{cpu:>8.1%}"
        )
    print(f"bus / raw ring: {ratio:.2f} (goal {GOAL_RATIO})   lost: {bus.lost} (goal 0)   "
          f"producer: {bus.producer_cpu_share:.1%} (goal {GOAL_CPU:.0%})")  # fmt: skip


if __name__ == "__main__":
    main()
