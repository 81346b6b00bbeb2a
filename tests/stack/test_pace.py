"""A demo runs as fast as the machine holds: what is too fast is tried again slower, from nothing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from endo3d.services.cli import demo, pace
from endo3d.services.cli.pace import PAPER_HZ, SLOWEST_HZ, Pace
from endo3d.services.cli.watch import Triggers
from endo3d.services.runtime import stack_file

FIRST = Pace(10.0, 20.0, "sim:contour?motion=hand")


def test_the_share_of_missed_triggers_counts_from_a_moment_on() -> None:
    assert Triggers(190, 30).missed_share(Triggers(100, 20)) == pytest.approx(0.1)
    assert Triggers().missed_share(Triggers()) == 0.0


def test_slow_motion_follows_the_rate() -> None:
    slower = FIRST.slower()
    assert slower is not None
    assert slower.rate_hz == 12.0
    assert slower.overrides() == [
        "sequencer.rate_hz=12.0",
        f"grabber.camera=sim:contour?motion=hand&slow_motion={PAPER_HZ / 12.0:.3f}",
    ]


def test_there_is_a_slowest() -> None:
    rates_hz = []
    tried: Pace | None = FIRST
    while tried is not None:
        rates_hz.append(tried.rate_hz)
        tried = tried.slower()
    assert rates_hz == sorted(rates_hz, reverse=True)
    assert rates_hz[-1] == SLOWEST_HZ


def test_the_measured_rate_is_within_its_limits() -> None:
    measured = pace.measure(stack_file.load("demo", ("grabber.camera=sim:contour?motion=hand&bin=4&slow_motion=3",)))
    assert measured is not None
    assert pace.SLOWEST_HZ <= measured.rate_hz <= pace.FASTEST_HZ
    assert measured.scene == "sim:contour?motion=hand&bin=4"


def test_a_rate_that_is_not_held_is_lowered_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine.txt").write_text("was here before")
    rates: list[str] = []

    def scan(stack: str, settings: list[str], seconds: float, quiet: bool, *, on_trial: bool = False) -> dict[str, Any]:
        rates.append(settings[0])
        (tmp_path / "scan.mcap").open("x").close()
        if on_trial and len(rates) < 3:
            raise demo.TooFast(0.5)
        return {"scan_s": seconds}

    monkeypatch.setattr(demo, "scan", scan)
    monkeypatch.setattr(demo, "_pace", lambda stack, settings: FIRST)
    figures = demo._scan_at_its_pace(tmp_path, "demo", [], 5.0, quiet=True)
    assert rates == ["sequencer.rate_hz=20.0", "sequencer.rate_hz=12.0", "sequencer.rate_hz=7.2"]
    assert figures == {"scan_s": 5.0, "render_ms": 10.0}
    assert {path.name for path in tmp_path.iterdir()} == {"mine.txt", "scan.mcap"}
