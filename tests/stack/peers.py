"""Child processes for tests of the bus: real processes, spoken to over a pipe."""

from __future__ import annotations

import multiprocessing
import os
import signal
import uuid
from collections.abc import Callable
from typing import Any, Self

_ANSWER_S = 120.0


def new_rig() -> str:
    """A rig name of its own for every test, so that tests of several checkouts never meet."""
    return f"test-{uuid.uuid4().hex[:12]}"


class Peer:
    """A process that runs ``work(pipe, *args)``. Leaving the ``with`` ends it."""

    def __init__(self, work: Callable[..., None], *args: Any) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self.process = context.Process(target=work, args=(theirs, *args), daemon=True)
        self.process.start()
        theirs.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if self.process.is_alive():
            self.kill()
        self._pipe.close()

    def say(self, word: Any) -> None:
        self._pipe.send(word)

    def hear(self) -> Any:
        """The child's next word; raises ``EOFError`` when it is dead, ``TimeoutError`` when it hangs."""
        if not self._pipe.poll(_ANSWER_S):
            raise TimeoutError("the child process says nothing")
        return self._pipe.recv()

    def ask(self, word: Any) -> Any:
        self.say(word)
        return self.hear()

    def kill(self) -> None:
        self.signal(signal.SIGKILL)
        self.process.join()

    def signal(self, number: int) -> None:
        pid = self.process.pid
        assert pid is not None
        os.kill(pid, number)

    def join(self) -> int | None:
        """Wait for its end; the exit code."""
        self.process.join(_ANSWER_S)
        return self.process.exitcode


def segments() -> set[str]:
    """The shared memory files that this process has mapped."""
    with open("/proc/self/maps") as maps:
        return {line.split()[-1] for line in maps if ".zenoh" in line}
