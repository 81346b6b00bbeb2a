"""A decoder on two hosts, over a real router: all results, in order; one is lost and the other goes on."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import scans
from one_machine import Alive, Host, Seen, hosts_of, rig_of, stack_of

from endo3d.schemas import topics
from endo3d.schemas.messages import Cloud, Frame, Message
from endo3d.services.runtime.bus import Bus

TWO = '[hosts.left]\nrole = "rig"\n[hosts.right]\nrole = "rig"\n'
FRAME = next(message for message in scans.messages(1) if isinstance(message, Frame))
CLOUD = next(message for message in scans.messages(1) if isinstance(message, Cloud))
PERIOD_S = 0.02
WINDOW = 7


class ActingDecoder:
    """On a host's mesh: a gap starts a new window, a full window gives the cloud of its centre."""

    def __init__(self, host: Host) -> None:
        self.taken: list[int] = []
        self._in_a_row = 0
        self.bus = host.open(f"decoder-{host.name}")
        self.bus.subscribe(topics.FRAME, self._take)
        self.bus.declare_alive()

    def _take(self, message: Message) -> None:
        assert isinstance(message, Frame)
        follows = bool(self.taken) and message.sequence == self.taken[-1] + 1
        self._in_a_row = self._in_a_row + 1 if follows else 1
        self.taken.append(message.sequence)
        if self._in_a_row >= WINDOW:
            self.bus.publish(replace(CLOUD, sequence=message.sequence - WINDOW // 2))


@contextmanager
def scanning(bus: Bus) -> Iterator[None]:
    """Frames at a steady pace, as long as the ``with`` lasts."""
    done = threading.Event()
    image = np.zeros((30, 40), np.uint8)

    def work() -> None:
        sequence = 0
        while not done.wait(PERIOD_S):
            frame = replace(FRAME, sequence=sequence, slot=sequence % 4, pattern_set="interleaved f1=15", image=image)
            bus.publish(frame)
            sequence += 1

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def test_two_decoders_and_then_one(tmp_path: Path) -> None:
    stack = stack_of(rig_of("shared"), hosts=TWO, decoder='host = ["left", "right"]')
    with hosts_of(stack, tmp_path / "keys") as hosts:
        decoders = {name: ActingDecoder(hosts[name]) for name in ("left", "right")}
        camera = hosts["rig"].open("scanner")
        clouds = Seen(hosts["rig"].open("odometry"), topics.CLOUD, keep=lambda cloud: cloud.sequence)
        Alive(camera).wait(lambda there: {"decoder-left", "decoder-right"} <= there)
        with scanning(camera):
            clouds.wait(lambda came: all(len(decoder.taken) > 60 for decoder in decoders.values()))
            clouds.wait(lambda came: len(came[topics.CLOUD]) > 100)
            lost_at = decoders["left"].taken[-1]
            decoders["left"].bus.close()
            clouds.wait(lambda came: came[topics.CLOUD][-1] > lost_at + 200)
        sequences: list[int] = clouds.messages[topics.CLOUD]
    assert sequences == sorted(set(sequences)), "in order, each once"
    assert not set(decoders["left"].taken) - set(range(lost_at + 1)), "nothing was sent to it any more"
    after = [sequence for sequence in sequences if sequence > lost_at + 100]
    assert after, "the other one goes on"


def test_both_decode_about_half(tmp_path: Path) -> None:
    """The price of sharing: frames just before a piece go to two hosts."""
    stack = stack_of(rig_of("halves"), hosts=TWO, decoder='host = ["left", "right"]')
    with hosts_of(stack, tmp_path / "keys") as hosts:
        decoders = {name: ActingDecoder(hosts[name]) for name in ("left", "right")}
        camera = hosts["rig"].open("scanner")
        Alive(camera).wait(lambda there: {"decoder-left", "decoder-right"} <= there)
        with scanning(camera):
            deadline = time.monotonic() + 200
            while min(len(decoder.taken) for decoder in decoders.values()) < 150 and time.monotonic() < deadline:
                time.sleep(0.1)
        left, right = (set(decoder.taken) for decoder in decoders.values())
    assert min(len(left), len(right)) >= 150
    both = {sequence for sequence in left & right if sequence > 100}
    assert len(both) < 0.3 * len(left | right)
