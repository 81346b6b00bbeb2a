"""What the child processes of the bus tests do, and the frames they exchange."""

from __future__ import annotations

import ctypes
import resource
import threading
import time
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from peers import segments

from endo3d.schemas import topics
from endo3d.schemas.messages import Frame, Message
from endo3d.services.runtime.bus import Bus

SHAPE = (120, 160)


def frame(bus: Bus, sequence: int, shape: tuple[int, int] = SHAPE, *, loaned: bool = True) -> Frame:
    """A frame whose pixels all follow from its number."""
    image = bus.loan(topics.FRAME, shape, np.uint8) if loaned else np.empty(shape, np.uint8)
    image[:] = sequence % 251
    return Frame(
        stamp_ns=time.time_ns(),
        sequence=sequence,
        image=image,
        pattern_set="interleaved f1=25",
        slot=sequence % 3,
        epoch=1,
        exposure_us=2900.0,
        trigger_ns=0,
        camera_frame_id=sequence,
    )


def is_whole(message: Frame) -> bool:
    return bool((message.image == message.sequence % 251).all())


def wait_for(bus: Bus, service: str) -> None:
    """Until ``service`` is there: what it subscribed to before is known here from then on."""
    there = threading.Event()

    def see(name: str, is_there: bool) -> None:
        if name == service and is_there:
            there.set()

    bus.watch_alive(see)
    assert there.wait(90), f"{service} did not come"


class Collector:
    """Frames as they come: how many, which, and whether they were whole."""

    def __init__(self) -> None:
        self.sequences: list[int] = []
        self.broken = 0
        self._came = threading.Condition()

    def take(self, message: Message) -> None:
        assert isinstance(message, Frame)
        whole = is_whole(message)
        with self._came:
            self.sequences.append(message.sequence)
            self.broken += not whole
            self._came.notify_all()

    def wait(self, sequence: int) -> None:
        with self._came:
            arrived = self._came.wait_for(
                lambda: bool(self.sequences) and max(self.sequences) >= sequence, 90
            )
        assert arrived, f"frame {sequence} did not come, only {self.sequences[-3:]}"


def read_frames(pipe: Connection, rig: str, options: dict[str, Any], pace_s: float = 0.0) -> None:
    """Reads frames; answers ``("until", n)`` with what came once frame n is there, ends on ``"stop"``."""
    with Bus.open(rig, name="reader", **options) as bus:
        collector = Collector()

        def take(message: Message) -> None:
            if pace_s:
                time.sleep(pace_s)  # the work of a slow reader
            collector.take(message)

        bus.subscribe(topics.FRAME, take)
        bus.declare_alive()
        pipe.send(bus.note)
        while (word := pipe.recv()) != "stop":
            collector.wait(word[1])
            _, _, dropped = bus.tally.snapshot()
            pipe.send((list(collector.sequences), collector.broken, dropped))


def hold_frames(pipe: Connection, rig: str) -> None:
    """Reads frames and holds the first three; answers each word with whether what it holds is intact."""
    held: list[Frame] = []
    came = threading.Event()
    with Bus.open(rig, name="holder") as bus:

        def take(message: Message) -> None:
            assert isinstance(message, Frame)
            if len(held) < 3:
                held.append(message)
            if len(held) == 3:
                came.set()

        bus.subscribe(topics.FRAME, take)
        bus.declare_alive()
        pipe.send("ready")
        while pipe.recv() != "stop":
            assert came.wait(90)
            pipe.send((bus.intact(), [is_whole(message) for message in held]))


def write_frames(pipe: Connection, rig: str) -> None:
    """Writes two frames to ``reader``; answers a word with the shared memory files that it has mapped."""
    with Bus.open(rig, name="writer") as bus:
        wait_for(bus, "reader")
        for sequence in range(2):
            bus.publish(frame(bus, sequence))
        pipe.send("written")
        while pipe.recv() != "stop":
            pipe.send(segments())


def limited(pipe: Connection, rig: str) -> None:
    """``read_frames`` of a process that may lock 64 kB and has no capability to ignore that."""
    resource.setrlimit(resource.RLIMIT_MEMLOCK, (65536, 65536))
    _drop_capabilities()
    read_frames(pipe, rig, {})


def _drop_capabilities() -> None:
    class Header(ctypes.Structure):
        _fields_ = (("version", ctypes.c_uint32), ("pid", ctypes.c_int))

    header = Header(0x20080522, 0)
    nothing = (ctypes.c_uint32 * 6)()
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.capset(ctypes.byref(header), ctypes.byref(nothing)) != 0:
        raise OSError(ctypes.get_errno(), "capset")
