"""What was recorded once is decoded for ever."""

from __future__ import annotations

from pathlib import Path

import pytest
from any_message import assert_equal, example
from mcap.reader import make_reader

from endo3d.schemas import codec, topics

LOGS = sorted((Path(__file__).parent / "logs").glob("*.mcap"))
BY_CHANNEL = {topic.channel("decoder"): topic for topic in topics.TOPICS}


@pytest.mark.parametrize("path", LOGS, ids=lambda path: path.stem)
def test_an_old_log_decodes(path):
    with path.open("rb") as stream:
        recorded = [
            (BY_CHANNEL[channel.topic], schema, record.data)
            for schema, channel, record in make_reader(stream).iter_messages()
        ]
    assert recorded
    for topic, schema, data in recorded:
        assert schema.name == codec.schema(topic).name
        assert_equal(codec.decode(topic, data), example(topic))


def test_every_topic_is_in_an_old_log():
    """v0 has what there was first; v1 has the topics that were added since."""
    assert [path.stem for path in LOGS] == ["v0", "v1"]
    channels: set[str] = set()
    for path in LOGS:
        with path.open("rb") as stream:
            channels |= {channel.topic for _, channel, _ in make_reader(stream).iter_messages()}
    assert {BY_CHANNEL[channel] for channel in channels} == set(topics.TOPICS)
