"""The table of what travels."""

from __future__ import annotations

import dataclasses
import math
from typing import get_args

import pytest

from endo3d.schemas import messages, topics

every_topic = pytest.mark.parametrize("topic", topics.TOPICS, ids=lambda topic: topic.name)


def test_every_message_has_one_topic():
    assert sorted(t.message.__name__ for t in topics.TOPICS) == sorted(
        m.__name__ for m in get_args(messages.Message)
    )
    assert len(topics.BY_NAME) == len(topics.BY_MESSAGE) == len(topics.TOPICS)


def test_keys_and_channels_are_distinct():
    assert len({topic.key("rig", "decoder") for topic in topics.TOPICS}) == len(topics.TOPICS)
    assert len({topic.channel("decoder") for topic in topics.TOPICS}) == len(topics.TOPICS)


@every_topic
def test_a_key_is_a_zenoh_key_of_its_rig(topic):
    key = topic.key("tip3", "decoder")
    assert key.startswith(f"endo3d/tip3/{topic.name}")
    assert "" not in key.split("/")
    assert not set(key) & set("*$?#")
    assert key.endswith("/decoder") == topic.per_service
    assert topic.key("tip3").endswith("/*") == topic.per_service
    assert topic.channel("decoder") == "/" + key.split("/", 2)[2]


@every_topic
def test_rates_and_depths_make_sense(topic):
    assert 0 < topic.rate_hz < math.inf
    assert topic.depth >= 1
    assert topic.log_hz >= 0
    # A slow reader pins its queue, the newest messages: of a pool of 40 frames a third must stay free.
    assert not topic.bulk or topic.depth <= 26
    assert not (topic.latched and topic.bulk)


@every_topic
def test_a_message_is_frozen_and_stamped(topic):
    fields = [field.name for field in dataclasses.fields(topic.message)]
    assert fields[0] == "stamp_ns"
    assert topic.message.__dataclass_params__.frozen


def test_control_and_liveliness_have_keys_of_their_own():
    keys = {topic.key("rig", "decoder") for topic in topics.TOPICS}
    assert topics.control_key("rig", "decoder", "mode") == "endo3d/rig/control/decoder/mode"
    assert topics.alive_key("rig", "decoder") == "endo3d/rig/alive/decoder"
    assert not keys & {topics.control_key("rig", "decoder", "mode"), topics.alive_key("rig", "decoder")}
