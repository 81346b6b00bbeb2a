"""A scan on the virtual rig, seen from another host over a thin link: live map, picture and pose, and what it took.

    python -m bench.hosts.scan [--mbit 100] [--seconds 20]
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
import time
from pathlib import Path

from bench.hosts.namespaces import Network, obstacle
from bench.hosts.rig import START_LIMIT_S, Hosts

STACK = "rig_workstation"
TOPICS = ("frame", "cloud", "pose", "map")
OWN = ("frame", "cloud", "pose", "map")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--mbit", type=float, default=100.0, help="what the link carries, both ways")
    parser.add_argument("--seconds", type=float, default=20.0)
    given = parser.parse_args()
    if why := obstacle():
        raise SystemExit(why)
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))  # namespaces have to be undone
    with tempfile.TemporaryDirectory() as folder, Network("rig", "workstation") as network:
        settings = [f"rig.name=scan{os.getpid()}", f"recorder.directory={folder}", "viewer.show=none"]
        network.limit("workstation", given.mbit)
        with Hosts(network, STACK, Path(folder), settings, {"rig": OWN, "workstation": TOPICS}) as hosts:
            print(_scan(hosts, given.seconds))


def _scan(hosts: Hosts, seconds: float) -> str:
    rig, far = hosts.witness["rig"], hosts.witness["workstation"]
    began_s = time.monotonic()
    try:
        for witness in (rig, far):
            witness.until(lambda now: all(now["counts"].get(topic) for topic in TOPICS), START_LIMIT_S)
    except TimeoutError as error:
        raise SystemExit(f"{error}\n{hosts.log('rig')}\n{hosts.log('workstation')}") from None
    start_s = time.monotonic() - began_s
    before, rig_before = far.now, rig.now
    time.sleep(seconds)
    after, rig_after = far.now, rig.now
    lasted_s = after["s"] - before["s"]
    carried = rig_after["services"]["relay-rig"]["values"].get("mbit_s to workstation", float("nan"))
    lines = [f"everything on the far host {start_s:.1f} s after the start; then {lasted_s:.1f} s:"]
    for topic in TOPICS:
        here = (rig_after["counts"][topic] - rig_before["counts"][topic]) / (rig_after["s"] - rig_before["s"])
        there = (after["counts"][topic] - before["counts"][topic]) / lasted_s
        age_ms = after["age_ms"][topic]
        lines.append(f"  {topic:<6} rig {here:6.1f} Hz   far {there:6.1f} Hz   age there {age_ms:6.0f} ms")
    lines.append(f"  map voxels: rig {rig_after['voxels']}, far {after['voxels']}; link {carried:.1f} Mbit/s")
    clock = after["services"].get("relay-workstation", {}).get("values", {})
    lines.append(
        f"  clock of the far host: {-clock.get('clock_offset_ms', float('nan')):+.2f} ms,"
        f" round trip {clock.get('round_trip_ms', float('nan')):.2f} ms"
    )
    mode = far.command("sequencer", "mode", {"mode": "conventional"})
    lines.append(f"  commanded from afar: mode {mode}")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
