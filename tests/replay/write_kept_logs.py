"""Writes the logs that later versions must read: python tests/replay/write_kept_logs.py VERSION

Run once per version that changes what is written, and never again for that version: what is in ``logs`` stays.
``scan`` is a few rendered frames as they travelled; ``packed`` is the same, cropped and compact; beside each, what
reading it gave then.
"""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path

import numpy as np
from rendered import write

from endo3d.schemas import topics
from endo3d.schemas.messages import Cloud, Frame, Truth
from endo3d.services import recorder
from endo3d.services.archive.facts import VERSION
from endo3d.services.archive.reader import Log
from endo3d.services.runtime import replay as engine
from endo3d.services.runtime.stack_file import stock

LOGS = Path(__file__).parent / "logs"
BIN_PX = 10


def contents(path: Path) -> dict:
    """What reading a log gives, exactly: the same on every machine."""
    log = Log(path)
    frames = [message for message in log.messages(topics.FRAME) if isinstance(message, Frame)]
    truths = [message for message in log.messages(topics.TRUTH) if isinstance(message, Truth)]
    return {
        "counts": {stream.name: stream.count for stream in log.streams.values()},
        "attachments": {name: hashlib.sha256(file).hexdigest() for name, file in log.attachments.items()},
        "frames": [
            {
                "stamp_ns": item.stamp_ns,
                "sequence": item.sequence,
                "pattern_set": item.pattern_set,
                "slot": item.slot,
                "epoch": item.epoch,
                "exposure_us": item.exposure_us,
                "trigger_ns": item.trigger_ns,
                "shape": list(item.image.shape),
                "sha256": hashlib.sha256(item.image.tobytes()).hexdigest(),
            }
            for item in frames
        ],
        "truth": [[item.sequence, *np.round(item.T_scene_camera[:3, 3], 9).tolist()] for item in truths],
    }


def decoded(path: Path) -> dict:
    """What the decoder makes of a log: about the same on every machine and in every version."""
    log = Log(path)
    with engine.stack_of(log) as stack, engine.pipeline_of(stack, ["decoder"]) as pipeline:
        results = [result.message for result in engine.replay(log, pipeline)]
    clouds = [message for message in results if isinstance(message, Cloud)]
    return {
        "sequences": [cloud.sequence for cloud in clouds],
        "valid": [cloud.valid_count for cloud in clouds],
        "median_z_mm": [float(np.nanmedian(cloud.points["z"])) for cloud in clouds],
    }


def main(version: str) -> None:
    folder = LOGS / version
    folder.mkdir(parents=True)
    head = str(stock("heads")["base6_wd20"])
    recorder.host_facts = lambda: {"endo3d": VERSION}  # whose machine it was is nobody's business
    write(folder / "scan.mcap", 9, BIN_PX)
    write(folder / "packed.mcap", 2, BIN_PX, crop=True, compact=True, head=head)
    for path in sorted(folder.glob("*.mcap")):
        path.with_suffix(".json").write_text(json.dumps(contents(path), indent=1) + "\n")
    (folder / "decoded.json").write_text(json.dumps(decoded(folder / "scan.mcap"), indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1])
