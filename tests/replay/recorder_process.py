"""A recorder in a process of its own, to be killed: python recorder_process.py DIRECTORY."""

from __future__ import annotations

import sys
import time
from pathlib import Path

from recorded import frame, mode, pose, projector, sample

from endo3d.services.recorder import Recorder, RecorderConfig

LATCHED = (projector(), mode())


def main() -> None:
    """Records 100 Hz frames and poses until killed.

    Each line says when a frame and its pose were taken, and how many frames were in the file then.
    """
    recorder = Recorder(RecorderConfig(directory=Path(sys.argv[1]), name="scan", floor_mb=0, reserve_mb=0))
    recorder.open()
    for latched in LATCHED:
        list(recorder.take(sample(latched)))
    sequence = 0
    started = time.monotonic()
    while True:
        time.sleep(max(0.0, started + sequence * 0.01 - time.monotonic()))
        for message in (frame(sequence), pose(sequence)):
            list(recorder.take(sample(message)))
        in_order = round(recorder.values()["messages"]) - len(LATCHED)  # frame, pose, frame, pose, ...
        print(time.monotonic_ns(), max(0, (in_order + 1) // 2), flush=True)
        sequence += 1


if __name__ == "__main__":
    main()
