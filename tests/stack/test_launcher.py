"""The launcher, with real processes: restart, give up, stop in order, and nothing left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from endo3d.services.runtime import launcher as launcher_module
from endo3d.services.runtime.launcher import Child, Launcher, State

PRELUDE = """
import os, signal, sys, time
from endo3d.services.runtime.launcher import follow_parent
follow_parent()
def say(text): print(text, flush=True)
def stopped(*_):
    say("closed")
    sys.exit(0)
"""
STEADY = PRELUDE + "signal.signal(signal.SIGTERM, stopped)\nsay('ready')\nwhile True: signal.pause()\n"
STUBBORN = (
    PRELUDE + "signal.signal(signal.SIGTERM, signal.SIG_IGN)\nsay('ready')\nwhile True: signal.pause()\n"
)

LIMIT_S = 90.0


def child(name: str, body: str, *, is_source: bool = False) -> Child:
    return Child(name, [sys.executable, "-c", body], is_source)


class Lines(list[tuple[str, str]]):
    def __call__(self, service: str, line: str) -> None:
        self.append((service, line))

    def of(self, service: str) -> list[str]:
        return [line for name, line in self if name == service]


def turn_until(launcher: Launcher, condition: Callable[[], bool]) -> None:
    end_s = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < end_s, "waited in vain"
        launcher.turn(0.05)


@pytest.fixture
def lines() -> Lines:
    return Lines()


@pytest.fixture
def quick_backoff(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(launcher_module, "BACKOFF_S", (0.01, 0.01, 0.01))
    return


def test_sources_stop_first_and_everybody_is_heard_to_the_end(lines: Lines) -> None:
    children = [child("camera", STEADY, is_source=True), child("decoder", STEADY), child("recorder", STEADY)]
    with Launcher(children, lines) as launcher:
        launcher.start()
        turn_until(launcher, lambda: [line for _, line in lines].count("ready") == 3)
        launcher.stop()
    assert [name for name, line in lines if line == "closed"] == ["camera", "decoder", "recorder"]
    assert launcher.exit_code == 0


def test_a_killed_service_is_restarted_and_the_others_run_on(lines: Lines, quick_backoff: None) -> None:
    steady, victim = child("steady", STEADY), child("victim", STEADY)
    with Launcher([steady, victim], lines) as launcher:
        launcher.start()
        turn_until(launcher, lambda: lines.of("victim") == ["ready"] and lines.of("steady") == ["ready"])
        first, other = victim.pid, steady.pid
        assert first is not None
        os.kill(first, signal.SIGKILL)
        turn_until(launcher, lambda: lines.of("victim").count("ready") == 2)
        assert victim.pid != first
        assert steady.pid == other
        assert victim.total_restarts == 1
        assert "killed by SIGKILL; restart 1 of 3 in 0.01 s" in lines.of("victim")
        launcher.stop()


def test_one_that_crashes_again_and_again_is_given_up(lines: Lines, quick_backoff: None) -> None:
    crashing = child("crashing", "raise SystemExit(7)")
    with Launcher([child("steady", STEADY), crashing], lines) as launcher:
        launcher.start()
        turn_until(launcher, lambda: crashing.state is State.GIVEN_UP)
        assert lines.of("crashing")[-1].startswith("ended with exit code 7; given up after 3 restarts")
        assert not launcher.done, "the others run on"
        launcher.stop()
    assert launcher.exit_code == 1


def test_one_that_cannot_start_for_the_users_reason_ends_the_stack(lines: Lines) -> None:
    wrong = child("recorder", "import sys; print('endo3d: the disk is full; free some'); sys.exit(2)")
    with Launcher([child("steady", STEADY), wrong], lines) as launcher:
        launcher.start()
        turn_until(launcher, lambda: launcher.done)
        launcher.stop()
    assert launcher.exit_code == 2
    assert launcher.user_error == "recorder: the disk is full; free some"


def test_the_stack_is_done_when_its_source_has_finished(lines: Lines) -> None:
    player = child(
        "player", PRELUDE + "say('last words without a newline', ) or sys.stdout.write('end')", is_source=True
    )
    with Launcher([player, child("recorder", STEADY)], lines) as launcher:
        launcher.start()
        turn_until(launcher, lambda: lines.of("recorder") == ["ready"])
        turn_until(launcher, lambda: launcher.done)
        launcher.stop()
    assert lines.of("player") == ["last words without a newline", "end"]
    assert lines.of("recorder") == ["ready", "closed"]
    assert launcher.exit_code == 0


def test_a_stubborn_service_is_killed_after_the_grace(lines: Lines) -> None:
    stubborn = child("stubborn", STUBBORN)
    with Launcher([stubborn], lines) as launcher:
        launcher.start()
        turn_until(launcher, lambda: lines.of("stubborn") == ["ready"])
        launcher.stop(grace_s=0.2)
    assert lines.of("stubborn")[-1] == "does not stop; killed"
    assert launcher.exit_code == 1


def test_what_a_killed_service_had_started_goes_with_it(lines: Lines) -> None:
    body = PRELUDE + textwrap.dedent("""
        import subprocess
        say(subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1000)"]).pid)
        while True: signal.pause()
    """)
    parent = child("viewer", body)
    with Launcher([parent], lines) as launcher:
        launcher.start()
        turn_until(launcher, lambda: bool(lines.of("viewer")))
        grandchild = psutil.Process(int(lines.of("viewer")[0]))
        assert parent.pid is not None
        os.kill(parent.pid, signal.SIGKILL)
        turn_until(launcher, lambda: parent.total_restarts == 1)
        assert gone(grandchild)


def test_nothing_is_left_when_the_launcher_itself_is_killed(tmp_path: Path) -> None:
    """Killed with -9, so no code of the launcher runs: the services still close what they have open."""
    report = tmp_path / "closed"
    body = STEADY.replace('say("closed")', f"open({str(report)!r}, 'w').close()")
    script = textwrap.dedent(f"""
        import sys
        from endo3d.services.runtime.launcher import Child, Launcher
        body = {body!r}
        recorder = Child("recorder", [sys.executable, "-c", body])
        launcher = Launcher([recorder], lambda name, line: print(line, flush=True))
        launcher.start()
        print(launcher.children[0].pid, flush=True)
        while True: launcher.turn()
    """)
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        service = psutil.Process(int(process.stdout.readline()))
        assert process.stdout.readline() == "ready\n"
        process.kill()
    assert gone(service)
    assert report.exists()


def gone(process: psutil.Process) -> bool:
    try:
        process.wait(LIMIT_S)
    except psutil.TimeoutExpired:
        return False
    return True
