"""A wire that delays and loses packets, in user space, for kernels without netem.

    python -m bench.hosts.wire DEVICE DEVICE DELAY_MS LOSS

Every packet that comes out of one device goes into the other, a delay later, or never. It says ``ready``.
"""

from __future__ import annotations

import contextlib
import random
import select
import socket
import sys
import time
from collections import deque

_ALL_PROTOCOLS = 0x0003
_SOL_PACKET, _IGNORE_OUTGOING, _VNET_HEADER = 263, 23, 15
_LARGEST = 70_000


def main() -> None:
    first, second, delay_s, loss = sys.argv[1], sys.argv[2], float(sys.argv[3]) / 1e3, float(sys.argv[4])
    ends = [_end(first), _end(second)]
    waiting: list[deque[tuple[float, bytes]]] = [deque(), deque()]
    """Packets on their way to each end, with the time they are due."""
    chance = random.Random(7)
    print("ready", flush=True)
    while True:
        due = [queue[0][0] for queue in waiting if queue]
        timeout_s = max(0.0, min(due) - time.monotonic()) if due else None
        for end in select.select(ends, [], [], timeout_s)[0]:
            target = 1 - ends.index(end)
            for packet in _packets(end):
                if chance.random() >= loss:
                    waiting[target].append((time.monotonic() + delay_s, packet))
        for end, queue in zip(ends, waiting, strict=True):
            while queue and queue[0][0] <= time.monotonic():
                _send(end, queue.popleft()[1])


def _end(device: str) -> socket.socket:
    end = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(_ALL_PROTOCOLS))
    end.setsockopt(_SOL_PACKET, _IGNORE_OUTGOING, 1)
    end.setsockopt(_SOL_PACKET, _VNET_HEADER, 1)  # checksums and sizes that are left to the hardware stay so
    end.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 16 << 20)
    end.bind((device, 0))
    end.setblocking(False)
    return end


def _packets(end: socket.socket) -> list[bytes]:
    packets: list[bytes] = []
    try:
        while len(packets) < 256:
            packets.append(end.recv(_LARGEST))
    except BlockingIOError:
        pass
    return packets


def _send(end: socket.socket, packet: bytes) -> None:
    with contextlib.suppress(OSError):  # the other side has no room: lost, as on a real link
        end.send(packet)


if __name__ == "__main__":
    main()
