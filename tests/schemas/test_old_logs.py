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
    assert {topic for topic, _, _ in recorded} == set(topics.TOPICS)
    for topic, schema, data in recorded:
        assert schema.name == codec.schema(topic).name
        assert_equal(codec.decode(topic, data), example(topic))


def test_there_is_an_old_log():
    assert [path.stem for path in LOGS] == ["v0"]
