"""Logs after an accident: bits turned over, pieces zeroed, the end cut off; read, repaired, read again."""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from endo3d.services.archive.reader import Log, Unreadable
from endo3d.services.archive.recover import recover
from endo3d.services.runtime.errors import UserError

BITS, PIECE_BYTES = 40, 65_536


@dataclass
class Verdict:
    """What became of the damaged logs."""

    logs: int = 0
    refused: int = 0
    """Not readable as they were, said in one line."""
    repaired: int = 0
    beyond_repair: int = 0
    messages: int = 0
    """Kept, in all; each with the checksum of its chunk."""
    misread: int = 0
    """Messages of a repaired log that are none of the whole one."""
    tracebacks: int = 0


def damage(log: Path, folder: Path, count: int, seed: int = 1) -> Verdict:
    """``count`` damaged copies of ``log``, one after the other, in ``folder``."""
    rng = np.random.default_rng(seed)
    genuine = {_fingerprint(record.payload) for record in Log(log).records()}
    verdict = Verdict(logs=count)
    for number in range(count):
        copy = folder / f"damaged-{number}.mcap"
        shutil.copyfile(log, copy)
        _break(copy, ("bits", "piece", "tail")[number % 3], rng)
        try:
            Log(copy)
        except Unreadable:
            verdict.refused += 1
        verdict.tracebacks += _cli_traceback(copy)
        try:
            recover(copy)
        except UserError:
            verdict.beyond_repair += 1
        else:
            verdict.repaired += 1
            for record in Log(copy).records(check=True):
                verdict.messages += 1
                verdict.misread += _fingerprint(record.payload) not in genuine
        for rest in folder.glob(f"damaged-{number}*"):
            rest.unlink()
    return verdict


def _break(path: Path, how: str, rng: np.random.Generator) -> None:
    size = path.stat().st_size
    with open(path, "r+b") as file:
        match how:
            case "bits":
                for offset in rng.integers(0, size, BITS):
                    file.seek(int(offset))
                    byte = file.read(1)[0]
                    file.seek(int(offset))
                    file.write(bytes([byte ^ 1 << int(rng.integers(8))]))
            case "piece":
                file.seek(int(rng.integers(0, size - PIECE_BYTES)))
                file.write(bytes(PIECE_BYTES))
            case _:
                file.truncate(int(rng.integers(8, size)))


def _cli_traceback(log: Path) -> int:
    """Whether a user would see a traceback."""
    endo3d = [sys.executable, "-m", "endo3d.services.cli.app"]
    done = subprocess.run([*endo3d, "export", str(log), str(log.with_suffix(".tum"))], capture_output=True, text=True)
    return int("Traceback" in done.stderr or done.returncode not in (0, 2))


def _fingerprint(payload: memoryview) -> int:
    return hash(bytes(payload))
