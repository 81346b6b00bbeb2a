"""A log file of the made-up scan."""

from __future__ import annotations

from pathlib import Path

import pytest
from scans import messages

from endo3d.schemas import codec, topics
from endo3d.services.archive.entry import Entry
from endo3d.services.archive.recording import Recording
from endo3d.services.archive.writer import Kind


@pytest.fixture(scope="session")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four frames and all that goes with them, as a recorder would have written them."""
    path = tmp_path_factory.mktemp("logs") / "scan.mcap"
    recording = Recording(path, {})
    for sequence, message in enumerate(messages(4)):
        topic = topics.of(message)
        kind = Kind(*codec.schema(topic))
        channel = topic.channel(getattr(message, "service", ""))
        payload = (codec.encode(message),)
        arrived_ns = message.stamp_ns + sequence
        recording.put(Entry(channel, kind, sequence, arrived_ns, message.stamp_ns, payload))
    recording.finish()
    return path
