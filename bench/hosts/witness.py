"""What one process on a host sees pass: a line of JSON every quarter of a second. Its input are commands.

    python -m bench.hosts.witness RIG PORT [TOPIC ...]
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections import Counter
from typing import Any

import numpy as np

from endo3d.schemas import topics
from endo3d.schemas.messages import Cloud, MapDelta, Message, Status
from endo3d.services.runtime.bus import Bus
from endo3d.services.runtime.errors import UserError
from endo3d.services.runtime.service import Refused

EVERY_S = 0.25


class Tally:
    """Per topic: how many, up to which sequence, how many sequences were left out, how old when they came."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.newest: dict[str, int] = {}
        self.backwards: Counter[str] = Counter()
        self.age_ms: dict[str, float] = {}
        self.stamps_s: dict[str, float] = {}
        self.skipped: Counter[str] = Counter()
        self.voxels: set[bytes] = set()
        self.statuses: dict[str, Status] = {}
        self.lock = threading.Lock()

    def take(self, message: Message) -> None:
        name = topics.of(message).name
        with self.lock:
            if isinstance(message, Status):
                self.statuses[message.service] = message
                return
            self.counts[name] += 1
            sequence = getattr(message, "sequence", self.counts[name])
            before = self.newest.get(name, sequence - 1)
            self.backwards[name] += sequence <= before
            self.skipped[name] += max(0, sequence - before - 1)
            self.newest[name] = sequence
            self.stamps_s[name] = 1e-9 * message.stamp_ns
            self.age_ms[name] = 1e-6 * (time.time_ns() - message.stamp_ns)
            if isinstance(message, MapDelta):
                keys = np.stack([message.points[key] for key in ("kx", "ky", "kz")], axis=-1).astype(np.int16)
                self.voxels.update(row.tobytes() for row in keys)
            if isinstance(message, Cloud):
                self.counts["points"] = message.valid_count

    def snapshot(self) -> dict[str, Any]:
        with self.lock:
            return {
                "s": time.monotonic(),
                "counts": dict(self.counts),
                "newest": dict(self.newest),
                "stamps_s": dict(self.stamps_s),
                "skipped": dict(self.skipped),
                "backwards": dict(self.backwards),
                "age_ms": dict(self.age_ms),
                "voxels": len(self.voxels),
                "services": {
                    name: {
                        "state": status.state,
                        "note": status.note,
                        "rate_hz": status.rate_hz,
                        "published": dict(status.published),
                        "dropped": dict(status.dropped),
                        "values": dict(status.values),
                    }
                    for name, status in self.statuses.items()
                },
            }


def main() -> None:
    rig, port, *wanted = sys.argv[1:]
    tally = Tally()
    with Bus.open(rig, name="witness", port=int(port)) as bus:
        for name in [*wanted, topics.STATUS.name]:
            bus.subscribe(topics.BY_NAME[name], tally.take)
        threading.Thread(target=_obey, args=(bus,), daemon=True).start()
        while True:
            print(json.dumps({**tally.snapshot(), "alive": sorted(bus.alive())}), flush=True)
            time.sleep(EVERY_S)


def _obey(bus: Bus) -> None:
    """Commands as lines of JSON: [service, verb, parameters]; the answer is a line with "answer"."""
    for line in sys.stdin:
        service, verb, parameters = json.loads(line)
        try:
            answer: Any = bus.call(service, verb, parameters, 10.0)
        except (Refused, UserError) as error:
            answer = str(error)
        print(json.dumps({"answer": answer}), flush=True)


if __name__ == "__main__":
    main()
