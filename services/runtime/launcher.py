"""Every service of a stack as a process of its own: start, watch, restart, stop, and leave nothing behind.

Consumers start first and sources stop first, so that the recorder sees the beginning and the end. One thread
and one selector: a child's death signal is tied to the thread that started it.
"""

from __future__ import annotations

import ctypes
import os
import resource
import selectors
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from enum import StrEnum

from endo3d.services.runtime.stack_file import Stack

PR_SET_PDEATHSIG = 1
BACKOFF_S = (0.2, 0.5, 1.0, 2.0, 5.0)
"""Wait before the n-th restart; after the last one the service is given up."""
SETTLED_S = 20.0
"""A service that ran this long starts with a clean record."""
STOP_GRACE_S = 30.0
"""From asking a service to stop to killing it."""
EXIT_USER_ERROR = 2

Sink = Callable[[str, str], None]
"""Takes (service, line) of what a service, or the launcher about it, says."""


class State(StrEnum):
    RUNNING = "running"
    WAITING = "waiting"
    """Crashed; the restart is due at ``Child.restart_at_s``."""
    FINISHED = "finished"
    GIVEN_UP = "given up"
    STOPPED = "stopped"


@dataclass
class Child:
    """One service's process."""

    name: str
    command: Sequence[str]
    is_source: bool = False
    nice: int = 0
    """From its first moment on: who yields to the others must not hold up their start either."""
    state: State = State.STOPPED
    restarts: int = 0
    """Since the last settled run."""
    total_restarts: int = 0
    exit_code: int | None = None
    """Of the last run; negative is a signal."""
    started_at_s: float = 0.0
    restart_at_s: float = 0.0
    process: subprocess.Popen[bytes] | None = field(default=None, repr=False)
    pidfd: int = -1
    partial: bytes = b""
    last_line: str = ""

    @property
    def pid(self) -> int | None:
        return self.process.pid if self.process else None


def children_of(stack: Stack, overrides: Sequence[str] = ()) -> list[Child]:
    """A child per service of a stack that runs on this host, in flow order; each validates its own table again."""
    assert stack.path is not None
    options = ["--stack", str(stack.path), *(part for override in overrides for part in ("--set", override))]
    if stack.host:
        options += ["--host", stack.host]
    command = [sys.executable, "-m", "endo3d.services.cli.app", "run"]
    share = stack.on(stack.host).share()
    return [
        Child(share[entry.name], [*command, entry.name, *options], entry.is_source, entry.kind.nice)
        for entry in stack.entries
        if entry.name in share
    ]


class Launcher:
    """Starts children, keeps them running, and stops them.

    ``turn`` does what is due and returns; the caller owns the loop, so that it can draw or measure between
    turns. Nothing is left running, even if this process is killed: see ``follow_parent``.
    """

    def __init__(self, children: Sequence[Child], sink: Sink, environment: Mapping[str, str] | None = None) -> None:
        self.children = list(children)
        self.sink = sink
        self.environment = {**_one_thread_each(), **os.environ, **(environment or {})}
        self.selector = selectors.DefaultSelector()
        self.user_error = ""
        """What a service said that could not even start for a reason the user has to remove."""

    def start(self) -> None:
        """Start all, consumers first."""
        raise_memlock()
        for child in reversed(self.children):
            self._spawn(child)

    def restart(self, name: str) -> None:
        """End one service as asked to, and start it again at the next turn."""
        child = next(child for child in self.children if child.name == name)
        self._end(child, STOP_GRACE_S, hurry=lambda: False)
        child.state, child.restart_at_s = State.WAITING, time.monotonic()
        self.sink(child.name, "restarted")

    def turn(self, timeout_s: float = 0.2) -> None:
        """Pass on what the services say, notice deaths, restart what is due; waits at most ``timeout_s``."""
        due = [child.restart_at_s for child in self.children if child.state is State.WAITING]
        wait_s = min([timeout_s, *(max(0.0, at_s - time.monotonic()) for at_s in due)])
        for key, _ in self.selector.select(wait_s):
            child, is_log = key.data
            if is_log:
                self._read(child)
            else:
                self._reap(child)
        for child in self.children:
            if child.state is State.WAITING and child.restart_at_s <= time.monotonic():
                self._spawn(child)

    @property
    def done(self) -> bool:
        """Nothing more will happen: a service refused to start, every source finished, or nobody runs."""
        sources = [child for child in self.children if child.is_source]
        return (
            bool(self.user_error)
            or (bool(sources) and all(child.state is State.FINISHED for child in sources))
            or all(child.state not in (State.RUNNING, State.WAITING) for child in self.children)
        )

    @property
    def exit_code(self) -> int:
        """2 if a service refused to start, 1 if one was given up or had to be killed, else 0."""
        if self.user_error:
            return EXIT_USER_ERROR
        fine = (0, None, -signal.SIGTERM)
        return int(any(child.state is State.GIVEN_UP or child.exit_code not in fine for child in self.children))

    def stop(self, grace_s: float = STOP_GRACE_S, hurry: Callable[[], bool] = lambda: False) -> None:
        """Stop all, sources first and one after the other, so that what is under way still arrives.

        A service that does not end within ``grace_s``, or once ``hurry`` says so, is killed.
        """
        for child in self.children:
            if child.state is State.WAITING:
                child.state = State.STOPPED
            if child.state is not State.RUNNING:
                continue
            self._end(child, grace_s, hurry)

    def _end(self, child: Child, grace_s: float, hurry: Callable[[], bool]) -> None:
        child.state = State.STOPPED
        self._signal(child, signal.SIGTERM)
        deadline_s = time.monotonic() + grace_s
        while child.process is not None:
            if hurry() or time.monotonic() > deadline_s:
                self.sink(child.name, "does not stop; killed")
                self._signal(child, signal.SIGKILL)
                deadline_s = time.monotonic() + grace_s
            self.turn(0.1)

    def close(self) -> None:
        """Kill what still runs; for the way out after a failure of the caller."""
        for child in self.children:
            child.state = State.STOPPED
            self._signal(child, signal.SIGKILL)
            while child.process is not None:
                self.turn(0.1)
        self.selector.close()

    def __enter__(self) -> Launcher:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _spawn(self, child: Child) -> None:
        child.process = subprocess.Popen(
            [*child.command],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={**self.environment, "ENDO3D_PARENT_PID": str(os.getpid()), "ENDO3D_NICE": str(child.nice)},
            start_new_session=True,
        )
        child.state, child.started_at_s, child.partial = State.RUNNING, time.monotonic(), b""
        child.pidfd = os.pidfd_open(child.process.pid)
        assert child.process.stdout is not None
        os.set_blocking(child.process.stdout.fileno(), False)
        self.selector.register(child.process.stdout, selectors.EVENT_READ, (child, True))
        self.selector.register(child.pidfd, selectors.EVENT_READ, (child, False))

    def _read(self, child: Child) -> None:
        if child.process is None or child.process.stdout is None:
            return
        with suppress(BlockingIOError):
            while chunk := os.read(child.process.stdout.fileno(), 65536):
                *lines, child.partial = (child.partial + chunk).split(b"\n")
                for line in lines:
                    self._say(child, line)
            self.selector.unregister(child.process.stdout)

    def _say(self, child: Child, line: bytes) -> None:
        child.last_line = line.decode(errors="replace")
        self.sink(child.name, child.last_line)

    def _reap(self, child: Child) -> None:
        """A process is gone: collect its last words and decide."""
        process = child.process
        assert process is not None
        assert process.stdout is not None
        code = process.wait()
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)  # what it started, and didn't end, goes with it
        if process.stdout in self.selector.get_map():
            self._read(child)
        if process.stdout in self.selector.get_map():
            self.selector.unregister(process.stdout)
        if child.partial:
            self._say(child, child.partial)
        process.stdout.close()
        self.selector.unregister(child.pidfd)
        os.close(child.pidfd)
        child.process, child.exit_code, child.partial = None, code, b""
        if child.state is State.RUNNING:
            self._decide(child, code)

    def _decide(self, child: Child, code: int) -> None:
        """What to do about a process that ended unasked."""
        if code == 0:
            child.state = State.FINISHED
            return
        if code == EXIT_USER_ERROR and child.total_restarts == 0:
            child.state = State.GIVEN_UP
            self.user_error = f"{child.name}: {child.last_line.removeprefix('endo3d: ')}"
            return
        if time.monotonic() - child.started_at_s > SETTLED_S:
            child.restarts = 0
        if child.restarts == len(BACKOFF_S):
            child.state = State.GIVEN_UP
            self.sink(
                child.name,
                f"{describe_exit(code)}; given up after {child.restarts} restarts: see its lines above",
            )
            return
        wait_s = BACKOFF_S[child.restarts]
        child.restarts += 1
        child.total_restarts += 1
        child.state, child.restart_at_s = State.WAITING, time.monotonic() + wait_s
        self.sink(child.name, f"{describe_exit(code)}; restart {child.restarts} of {len(BACKOFF_S)} in {wait_s} s")

    @staticmethod
    def _signal(child: Child, number: signal.Signals) -> None:
        if child.process is not None:
            child.process.send_signal(number)


def describe_exit(code: int) -> str:
    """An exit code in words."""
    return f"killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"


def raise_memlock() -> None:
    """Let the children lock as much memory as permitted: each locks the whole shared-memory pool."""
    _, hard = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    for limit in ((resource.RLIM_INFINITY, resource.RLIM_INFINITY), (hard, hard)):
        with suppress(ValueError, OSError):
            resource.setrlimit(resource.RLIMIT_MEMLOCK, limit)
            return


def follow_parent() -> None:
    """In a child, first thing: end when the launcher ends, however that happens.

    The kernel sends SIGTERM when the launcher dies, so that an archive is still closed. A launcher that was
    gone before that was set up is noticed by the parent's number.
    """
    parent = os.environ.pop("ENDO3D_PARENT_PID", "")
    if not parent:
        return
    ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    if os.getppid() != int(parent):
        raise SystemExit(128 + signal.SIGTERM)


def _one_thread_each() -> dict[str, str]:
    """A service computes in one thread; libraries that would each start a pool of their own are told so."""
    return dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
