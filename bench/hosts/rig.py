"""Hosts that run their shares of a stack, each in its namespace, with a witness on each."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from bench.hosts.namespaces import Network
from endo3d.services.runtime.certificates import make_authority, make_host
from endo3d.services.runtime.stack_file import load

PORT = 21_000
"""Of every host's mesh: they never meet."""
START_LIMIT_S = 300.0


class Witness:
    """What passes on one host, as the newest line of its witness says."""

    def __init__(self, process: subprocess.Popen[Any]) -> None:
        self.process = process
        self.now: dict[str, Any] = {}
        self.answers: list[Any] = []
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def until(self, condition: Callable[[dict[str, Any]], Any], limit_s: float = 120.0) -> dict[str, Any]:
        """The first state that fulfils the condition. Raises ``TimeoutError`` with the last one."""
        with self._changed:
            if not self._changed.wait_for(lambda: bool(self.now) and condition(self.now), limit_s):
                raise TimeoutError(f"not within {limit_s:g} s: {self.now}")
            return self.now

    def command(self, service: str, verb: str, parameters: Mapping[str, Any] | None = None) -> Any:
        """A command given on this host; the reply, or the refusal's text."""
        before = len(self.answers)
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps([service, verb, dict(parameters or {})]) + "\n")
        self.process.stdin.flush()
        with self._changed:
            if not self._changed.wait_for(lambda: len(self.answers) > before, 60.0):
                raise TimeoutError(f"no answer to {service} {verb}")
            return self.answers[before]

    def count(self, topic: str) -> int:
        return int(self.now.get("counts", {}).get(topic, 0))

    def close(self) -> None:
        self.process.terminate()
        self.process.wait()
        self._thread.join()
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                pipe.close()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            said = json.loads(line)
            with self._changed:
                if "answer" in said:
                    self.answers.append(said["answer"])
                else:
                    self.now = said
                self._changed.notify_all()


class Hosts:
    """The shares of a stack, running. A context manager."""

    def __init__(
        self,
        network: Network,
        stack: Path | str,
        folder: Path,
        settings: Sequence[str],
        topics: Mapping[str, Sequence[str]],
    ) -> None:
        """``topics``: what the witness on each host counts."""
        self.network = network
        self._topics = topics
        self.folder = folder
        router = load(stack).placement.router
        shared = [f"rig.port={PORT}", f"rig.keys={folder / 'keys'}"]
        shared.append(f"hosts.{router}.address={network.address[router]}")
        self.stack = load(stack, [*shared, *settings])
        self._file = folder / "stack.toml"
        self._file.write_text(self.stack.toml)
        self._closing = ExitStack()
        self.witness: dict[str, Witness] = {}
        self.up: dict[str, subprocess.Popen[Any]] = {}

    def __enter__(self) -> Self:
        keys = self.folder / "keys"
        make_authority(keys, self.stack.rig.name, 2)
        for name, host in self.stack.placement.hosts.items():
            make_host(keys, keys, name, host.role, [self.network.address.get(name, name)], 2)
        for name in self.network.names:
            self.start(name)
        return self

    def start(self, name: str) -> None:
        """A host's share, and its witness if it has none yet."""
        output = self._closing.enter_context((self.folder / f"{name}.log").open("ab"))
        endo3d = [sys.executable, "-m", "endo3d.services.cli.app", "up", str(self._file), "--host", name]
        self.up[name] = self.network.start(name, endo3d, stdout=output, stderr=subprocess.STDOUT)
        if name not in self.witness:
            command = [sys.executable, "-m", "bench.hosts.witness", self.stack.rig.name, str(PORT)]
            pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
            self.witness[name] = Witness(self.network.start(name, [*command, *self._topics.get(name, ())], **pipes))

    def log(self, name: str) -> str:
        """What a host's services said."""
        return (self.folder / f"{name}.log").read_text(errors="replace")

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for witness in self.witness.values():
            witness.close()
        for process in self.up.values():
            process.terminate()
        for process in self.up.values():
            process.wait(60)
        self._closing.close()


def pace(witness: Witness, topic: str, seconds: float) -> float:
    """Messages a second of a topic, over so long."""
    before = witness.until(lambda now: topic in now["counts"], START_LIMIT_S)
    time.sleep(seconds)
    after = witness.until(lambda now: now["s"] >= before["s"] + seconds)
    counted = after["counts"][topic] - before["counts"][topic]
    return float(counted / (after["s"] - before["s"]))
