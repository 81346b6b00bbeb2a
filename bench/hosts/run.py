"""What happens to a rig and to its far host on good and bad links; the table in docs/deployment.md.

Two hosts in network namespaces, mutual TLS. The rig's source makes what a scan at 30 Hz makes (960 x 600 frames,
480 x 300 clouds: 121 MB/s), a reader on the rig takes all of it; the far host gets a preview. The rig must not
notice anything: its rate within 2 %, nothing lost by its own reader that is not lost without a far host.

    python -m bench.hosts.run [--seconds 8]
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import psutil

from bench.hosts.namespaces import Network, obstacle
from bench.hosts.rig import START_LIMIT_S, Hosts

STACK = Path(__file__).with_name("steady.toml")
TOPICS = ("frame", "cloud", "pose", "map")
OWN = ("frame", "cloud", "pose")
"""What the reader on the rig takes, all of it."""
RIG_HZ = 30.0
WITHIN = 0.02
CUT_S = 5.0


@dataclass(frozen=True)
class Figures:
    """Of one stretch of time."""

    rig_hz: float
    """By the stamps and sequence numbers of what was published."""
    rig_lost: int
    """Messages that the rig's own reader did not get."""
    far_hz: dict[str, float]
    far_age_ms: dict[str, float]
    """From the stamp to the arrival of the last one."""


class Run:
    """A rig, a workstation, and what is measured on them."""

    def __init__(self, network: Network, hosts: Hosts) -> None:
        self.network, self.hosts = network, hosts
        self.rig, self.far = hosts.witness["rig"], hosts.witness["workstation"]

    def until_it_gets_there(self, limit_s: float = START_LIMIT_S) -> float:
        """Until something new of every topic is on the far host; the seconds that took. Raises ``TimeoutError``."""
        began_s, before = time.monotonic(), dict(self.far.now.get("counts", {}))
        self.far.until(lambda now: all(now["counts"].get(t, 0) > before.get(t, 0) for t in TOPICS), limit_s)
        return time.monotonic() - began_s

    def measure(self, seconds: float) -> Figures:
        rig, far = self.rig.now, self.far.now
        time.sleep(seconds)
        rig_after, far_after = self.rig.until(lambda now: now["s"] >= rig["s"] + seconds), self.far.now
        far_s = max(far_after["s"] - far["s"], 1e-3)
        published = rig_after["newest"]["pose"] - rig["newest"]["pose"]
        return Figures(
            rig_hz=published / max(rig_after["stamps_s"]["pose"] - rig["stamps_s"]["pose"], 1e-9),
            rig_lost=sum(rig_after["skipped"][t] - rig["skipped"][t] for t in OWN),
            far_hz={t: (far_after["counts"].get(t, 0) - far["counts"].get(t, 0)) / far_s for t in TOPICS},
            far_age_ms=dict(far_after.get("age_ms", {})),
        )

    def relay(self, host: str) -> psutil.Process:
        """The process of a host's relay."""
        return self._service(host, "relay")

    def router(self) -> psutil.Process:
        return self._service("rig", "router")

    def _service(self, host: str, name: str) -> psutil.Process:
        launcher = psutil.Process(self.hosts.up[host].pid)
        return next(child for child in launcher.children(recursive=True) if name in child.cmdline())


@contextmanager
def running(settings: tuple[str, ...] = ()) -> Iterator[Run]:
    """Both hosts up, and everything arriving."""
    with tempfile.TemporaryDirectory() as folder, Network("rig", "workstation") as network:
        name = f"rig.name=steady{os.getpid()}"
        with Hosts(network, STACK, Path(folder), [name, *settings], {"rig": OWN, "workstation": TOPICS}) as hosts:
            run = Run(network, hosts)
            try:
                run.rig.until(lambda now: all(now["counts"].get(t) for t in OWN), START_LIMIT_S)
                run.until_it_gets_there()
            except TimeoutError as error:
                raise TimeoutError(f"{error}\n{hosts.log('rig')}\n{hosts.log('workstation')}") from None
            yield run


def stop_the_viewer(run: Run, seconds: float) -> Figures:
    """The far relay stands still and takes nothing, its connection open."""
    relay = run.relay("workstation")
    relay.send_signal(signal.SIGSTOP)
    try:
        return run.measure(seconds)
    finally:
        relay.send_signal(signal.SIGCONT)


def cut_the_link(run: Run, seconds: float) -> Figures:
    run.network.cut("workstation")
    figures = run.measure(CUT_S)
    run.network.mend("workstation")
    return figures


def kill_the_router(run: Run, seconds: float) -> Figures:
    run.router().kill()
    return run.measure(seconds)


def kill_the_relay(run: Run, seconds: float) -> Figures:
    run.relay("rig").kill()
    return run.measure(seconds)


TROUBLES: dict[str, Callable[[Run, float], Figures]] = {
    "the far host stands still": stop_the_viewer,
    f"link cut for {CUT_S:g} s": cut_the_link,
    "router killed": kill_the_router,
    "the rig's relay killed": kill_the_relay,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seconds", type=float, default=8.0, help="of every row")
    seconds = parser.parse_args().seconds
    if why := obstacle():
        raise SystemExit(why)
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))  # namespaces have to be undone
    print("| link, or what happens | rig Hz | lost there | images, clouds, poses, map Hz | age ms | back after s |")
    print("|---|---|---|---|---|---|", flush=True)
    worst = 0.0
    with running() as run:
        baseline = run.measure(seconds)
        _row("no limit", baseline)
        for mbit_s in (1000.0, 100.0):
            run.network.limit("workstation", mbit_s)
            time.sleep(1.0)
            figures = run.measure(seconds)
            worst = max(worst, abs(figures.rig_hz / RIG_HZ - 1))
            _row(f"{mbit_s:g} Mbit/s", figures)
        for name, trouble in TROUBLES.items():
            figures = trouble(run, seconds)
            worst = max(worst, abs(figures.rig_hz / RIG_HZ - 1))
            _row(f"100 Mbit/s, {name}", figures, run.until_it_gets_there())
    for delay_ms, loss in ((50.0, 0.0), (0.0, 0.01), (50.0, 0.01)):
        with running() as run:
            how = run.network.worsen("workstation", delay_ms=delay_ms, loss=loss)
            back_s = run.until_it_gets_there()
            time.sleep(2.0)
            figures = run.measure(seconds)
            worst = max(worst, abs(figures.rig_hz / RIG_HZ - 1))
            _row(f"{delay_ms:g} ms each way, {loss:.0%} lost ({how})", figures, back_s)
    verdict = "met" if worst <= WITHIN else "missed"
    print(f"\nThe rig's own rate changed by {100 * worst:.2f} % at most (goal {100 * WITHIN:g} %: {verdict}).")


def _row(what: str, figures: Figures, back_s: float | None = None) -> None:
    rates = ", ".join(f"{figures.far_hz[t]:.1f}" for t in TOPICS)
    ages = ", ".join(f"{figures.far_age_ms.get(t, float('nan')):.0f}" for t in TOPICS)
    back = "" if back_s is None else f"{back_s:.1f}"
    print(f"| {what} | {figures.rig_hz:.2f} | {figures.rig_lost} | {rates} | {ages} | {back} |", flush=True)


if __name__ == "__main__":
    main()
