"""A virtual run as a log. Interrupted, it goes on from the frames that are whole in the unfinished file."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

from endo3d.schemas import topics
from endo3d.schemas.messages import Frame, Truth
from endo3d.services.archive.entry import entry_of
from endo3d.services.archive.facts import host_facts
from endo3d.services.archive.reader import Log, Unreadable
from endo3d.services.archive.recording import Recording
from endo3d.services.archive.recover import recover
from endo3d.services.evaluation.cache import program
from endo3d.services.evaluation.virtual_run import VirtualRun
from endo3d.services.runtime.errors import UserError

DESCRIPTION = "endo3d.run"
"""The fact of the log that tells which run it holds."""
FLUSH_FRAMES = 50


def prerender(run: VirtualRun, path: Path, threads: int, progress: Callable[[int], None]) -> None:
    """Render what is missing of ``run`` into the log ``path``.

    Raises ``UserError`` when ``path`` exists and is complete, or holds another run.
    """
    unfinished, kept = path.with_suffix(".unfinished.mcap"), path.with_suffix(".kept.mcap")
    if path.exists():
        raise UserError(f"{path} exists; remove it, or choose another name")
    if unfinished.exists():
        _keep(unfinished, kept, run)
    recording = Recording(unfinished, {**host_facts(), DESCRIPTION: name(run)})
    done = 0
    try:
        for message in (*run.calibration(), run.mode()):
            recording.put(entry_of(message))
        if kept.exists():
            for frame, truth in frames_of(kept):
                _put(recording, frame, truth)
                done += 1
            kept.unlink()
        progress(done)
        for frame, truth in run.shots(done, threads):
            _put(recording, frame, truth)
            done += 1
            progress(done)
            if done % FLUSH_FRAMES == 0:
                recording.flush()
    finally:
        recording.finish()
    os.replace(unfinished, path)


def _put(recording: Recording, frame: Frame, truth: Truth) -> None:
    recording.put(entry_of(truth))
    recording.put(entry_of(frame))


def _keep(unfinished: Path, kept: Path, run: VirtualRun) -> None:
    """Move what an interrupted rendering left to ``kept``, if it is of the same run."""
    try:
        recover(unfinished)
        facts = Log(unfinished).facts["endo3d"]
    except Unreadable:
        unfinished.unlink()  # it ended before its first whole chunk
        return
    if facts.get(DESCRIPTION) != name(run):
        raise UserError(f"{unfinished} is of another rendering; remove it, or choose another name")
    if kept.exists() and Log(kept).count(topics.FRAME) > Log(unfinished).count(topics.FRAME):
        unfinished.unlink()  # interrupted while it took over what was kept
    else:
        os.replace(unfinished, kept)


def frames_of(log: Path) -> Iterator[tuple[Frame, Truth]]:
    """Whole pairs, from the first frame on, without a gap."""
    truths = {m.sequence: m for m in Log(log).messages(topics.TRUTH) if isinstance(m, Truth)}
    for expected, message in enumerate(Log(log).messages(topics.FRAME)):
        assert isinstance(message, Frame)
        if message.sequence != expected or expected not in truths:
            return
        yield message, truths[expected]


def name(run: VirtualRun) -> str:
    """Tells runs apart: a hash of everything that decides the frames, the program that renders them included."""
    run_and_program = (sorted(asdict(run).items()), program("endo3d_core.virtual_rig"))
    return hashlib.sha256(repr(run_and_program).encode()).hexdigest()[:32]
