"""Two hosts in network namespaces of their own, whole processes, mutual TLS; on a thin link, and on bad days.

What must hold on any machine: the rig goes on, and everything is back on the far host afterwards. The figures,
with the rig's rate to 2 %, are `python -m bench.hosts.run`'s.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from bench.hosts.namespaces import obstacle
from bench.hosts.run import TROUBLES, Figures, Run, running

WHY_NOT = obstacle()
pytestmark = [pytest.mark.net, pytest.mark.skipif(bool(WHY_NOT), reason=WHY_NOT)]

LIMIT_S = 200.0


@pytest.fixture(scope="module")
def run() -> Iterator[Run]:
    """Both hosts on a link of 100 Mbit/s."""
    with running() as both:
        both.network.limit("workstation", 100.0)
        yield both


def test_a_thin_link_gives_a_live_map_and_picture(run: Run) -> None:
    run.until_it_gets_there(LIMIT_S)
    assert not any(run.far.now["backwards"].values()), "never back in time"


def test_every_host_sees_the_services_of_all(run: Run) -> None:
    everybody = {"source", "local", "relay-rig", "router", "remote", "relay-workstation"}
    for witness in (run.rig, run.far):
        witness.until(lambda now: everybody <= set(now["services"]), LIMIT_S)


def test_no_secret_is_in_a_log_or_a_stack_file(run: Run) -> None:
    folder = run.hosts.folder
    secrets = [line for key in (folder / "keys").glob("*.key") for line in key.read_text().splitlines()[1:-1]]
    written = (folder / "stack.toml").read_text() + run.hosts.log("rig") + run.hosts.log("workstation")
    assert len(secrets) >= 6
    assert not [secret for secret in secrets if secret in written]


def test_a_command_gets_there_and_back(run: Run) -> None:
    """This service knows none, and says so."""
    assert any("no command" in run.far.command("source", "dance") for _ in range(5))


@pytest.mark.parametrize("what", TROUBLES)
def test_the_rig_goes_on_and_the_far_host_comes_back(run: Run, what: str) -> None:
    trouble: Callable[[Run, float], Figures] = TROUBLES[what]
    before = run.rig.count("pose")
    trouble(run, 1.0)
    run.rig.until(lambda now: now["counts"]["pose"] > before, LIMIT_S)
    run.until_it_gets_there(LIMIT_S)
