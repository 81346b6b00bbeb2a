"""The sequencer over a projector that is unplugged in mid-run: a clear state, and it goes on by itself."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from plugged import WINDOW, Plugged

import endo3d.deploy
from endo3d.schemas.messages import Message, Mode
from endo3d.services import sequencer
from endo3d.services.runtime.service import Refused
from endo3d.services.sequencer import Sequencer, SequencerConfig
from endo3d_core import patterns

HEAD = str(Path(endo3d.deploy.__path__[0]) / "heads" / "base6_wd20.yaml")


@pytest.fixture
def running(plugged: Plugged, monkeypatch: pytest.MonkeyPatch) -> Iterator[Sequencer]:
    monkeypatch.setattr(sequencer, "open_projector", lambda uri, setting: plugged.projector)
    monkeypatch.setattr(sequencer, "LOOK_NS", 0)
    service = Sequencer(SequencerConfig(projector="dlpc900:", head=HEAD))
    service.open()
    assert [message.running for message in polled(service, 1)] == [True]
    yield service
    service.close()


def polled(service: Sequencer, times: int) -> list[Mode]:
    messages: list[Message] = [message for _ in range(times) for message in service.poll(0.0)]
    assert all(isinstance(message, Mode) for message in messages)
    return messages  # type: ignore[return-value]


def commanded(action: Callable[[], Iterator[object]]) -> list[Mode]:
    return [each for each in action() if isinstance(each, Mode)]


def test_all_is_quiet_while_it_runs(running: Sequencer) -> None:
    assert polled(running, 5) == []
    assert running.trouble() == ""


def test_unplugged_and_plugged_in_again(running: Sequencer, plugged: Plugged) -> None:
    first = running.shown
    assert first is not None
    plugged.port.unplug()
    (stopped,) = polled(running, 3)
    assert not stopped.running
    assert "plug it in" in running.trouble()
    plugged.port.plug_in()
    (again,) = polled(running, 3)
    assert again.running
    assert again.epoch > first.epoch
    assert again.pattern_set == first.pattern_set
    assert running.trouble() == ""
    assert running.values()["resumed"] == 1.0
    shown = plugged.shows[-1].patterns
    top, left = (1080 - WINDOW[1]) // 2, (1920 - WINDOW[0]) // 2
    for each, pattern in zip(shown, patterns.parse(again.pattern_set).patterns, strict=True):
        inside = each.pixels[top : top + WINDOW[1], left : left + WINDOW[0]]
        np.testing.assert_array_equal(inside, patterns.image(pattern, *WINDOW))


def test_a_command_while_it_is_away_is_refused_and_the_old_mode_resumes(running: Sequencer, plugged: Plugged) -> None:
    plugged.port.unplug()
    with pytest.raises(Refused, match="plug"):
        list(running.command("mode", {"mode": "conventional"}, 0))
    plugged.port.plug_in()
    assert polled(running, 3)[-1].mode == "interleaved"


def test_a_switch_to_a_set_that_does_not_fit_leaves_what_was(running: Sequencer) -> None:
    with pytest.raises(Refused, match="holds 18"):
        list(running.command("mode", {"mode": "sequence f=" + "/".join(["3"] * 60) + " shifts=" + "/".join(
            f"{k / 10}" for k in range(60))}, 0))  # fmt: skip
    assert polled(running, 3)[-1].mode == "interleaved"


def test_stopped_stays_stopped(running: Sequencer) -> None:
    (stopped,) = commanded(lambda: running.command("stop", {}, 0))
    assert not stopped.running
    assert polled(running, 3) == []
