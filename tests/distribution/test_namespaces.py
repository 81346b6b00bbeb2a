"""Two hosts in network namespaces of their own, whole processes, mutual TLS; on a thin link, and on bad days.

What must hold on any machine: the rig goes on, and everything is back on the far host afterwards. The figures,
with the rig's rate to 2 %, are `python -m bench.hosts.run`'s.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from bench.hosts.namespaces import obstacle
from bench.hosts.run import RIG_HZ, TOPICS, TROUBLES, Figures, Run, running

WHY_NOT = obstacle()
pytestmark = [pytest.mark.net, pytest.mark.skipif(bool(WHY_NOT), reason=WHY_NOT)]

BACK_S = 90.0


@pytest.fixture(scope="module")
def run() -> Iterator[Run]:
    """Both hosts on a link of 100 Mbit/s."""
    with running() as both:
        both.network.limit("workstation", 100.0)
        yield both


def test_a_thin_link_gives_a_live_map_and_picture(run: Run) -> None:
    figures = run.measure(2.0)
    assert all(figures.far_hz[topic] > 0 for topic in TOPICS)
    assert not any(run.far.now["backwards"].values()), "never back in time"
    assert {"source", "local", "relay-rig", "router", "remote", "relay-workstation"} <= set(run.far.now["services"])


def test_no_secret_is_in_a_log_or_a_stack_file(run: Run) -> None:
    folder = run.hosts.folder
    secrets = [line for key in (folder / "keys").glob("*.key") for line in key.read_text().splitlines()[1:-1]]
    written = (folder / "stack.toml").read_text() + run.hosts.log("rig") + run.hosts.log("workstation")
    assert len(secrets) >= 6
    assert not [secret for secret in secrets if secret in written]


def test_who_may_not_is_told_so_from_afar(run: Run) -> None:
    """The command gets there and back: this service knows none."""
    assert "no command" in run.far.command("source", "dance")


@pytest.mark.parametrize("what", TROUBLES)
def test_the_rig_goes_on_and_the_far_host_comes_back(run: Run, what: str) -> None:
    trouble: Callable[[Run, float], Figures] = TROUBLES[what]
    figures = trouble(run, 2.0)
    assert figures.rig_hz > RIG_HZ / 2
    run.until_it_gets_there(BACK_S)
