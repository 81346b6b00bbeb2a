"""Rendered logs: what is in them, and that an interruption leaves no trace."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from endo3d.schemas import topics
from endo3d.schemas.messages import Frame, Mode, ProjectorCalibration, Truth
from endo3d.services.archive.reader import Log
from endo3d.services.cli.app import app
from endo3d.services.evaluation.prerender import prerender
from endo3d.services.evaluation.virtual_run import VirtualRun, head_yaml
from endo3d.services.runtime.errors import UserError
from endo3d_core.virtual_rig.effects import FAST

RUN = VirtualRun(
    head_yaml("base6_wd20"), "contour", "hand seed=3", "interleaved f1=15", 172.0, 60, effects=FAST, bin_px=8
)


def messages(path: Path) -> list[tuple[str, bytes]]:
    return [(record.stream.name, bytes(record.payload)) for record in Log(path).records()]


def ignore(done: int) -> None:
    """Progress that nobody watches."""


def test_a_log_has_frames_truth_and_calibration(tmp_path: Path) -> None:
    prerender(RUN, tmp_path / "a.mcap", 1, ignore)
    log = Log(tmp_path / "a.mcap")
    frames = [m for m in log.messages(topics.FRAME) if isinstance(m, Frame)]
    truths = [m for m in log.messages(topics.TRUTH) if isinstance(m, Truth)]
    assert [f.sequence for f in frames] == list(range(60)) == [t.sequence for t in truths]
    assert [f.slot for f in frames[:5]] == [0, 1, 2, 3, 0]
    assert np.diff([f.stamp_ns for f in frames]) == pytest.approx(1e9 / 172, abs=2)
    assert np.array_equal(frames[0].image, next(RUN.shots())[0].image)
    (mode,) = log.messages(topics.MODE)
    assert isinstance(mode, Mode)
    assert mode.pattern_set == "interleaved f1=15"
    (projector,) = log.messages(topics.PROJECTOR)
    assert isinstance(projector, ProjectorCalibration)
    assert projector.yaml == RUN.head_yaml


@pytest.mark.parametrize("at", [1, 37])
def test_an_interrupted_rendering_goes_on(tmp_path: Path, at: int) -> None:
    """The log is the same as if nothing had happened, and what was there is not rendered again."""
    prerender(RUN, tmp_path / "whole.mcap", 1, ignore)
    path = tmp_path / "torn.mcap"

    def stop(done: int) -> None:
        if done == at:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        prerender(RUN, path, 1, stop)
    assert not path.exists()
    begun: list[int] = []
    prerender(RUN, path, 1, begun.append)
    assert begun[0] == at
    assert messages(path) == messages(tmp_path / "whole.mcap")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["torn.mcap", "whole.mcap"]


def test_a_killed_rendering_goes_on(tmp_path: Path) -> None:
    """The unfinished file is torn in the middle of a frame."""
    prerender(RUN, tmp_path / "whole.mcap", 1, ignore)
    torn = (tmp_path / "whole.mcap").read_bytes()
    (tmp_path / "x.unfinished.mcap").write_bytes(torn[: len(torn) * 2 // 3])
    begun: list[int] = []
    prerender(RUN, tmp_path / "x.mcap", 1, begun.append)
    assert 20 < begun[0] < 60
    assert messages(tmp_path / "x.mcap") == messages(tmp_path / "whole.mcap")


def test_another_run_is_not_mixed_in(tmp_path: Path) -> None:
    def stop(done: int) -> None:
        if done == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        prerender(RUN, tmp_path / "x.mcap", 1, stop)
    other = VirtualRun(RUN.head_yaml, "plane", "still", RUN.pattern_set, RUN.rate_hz, 10, effects=FAST, bin_px=8)
    with pytest.raises(UserError, match="another rendering"):
        prerender(other, tmp_path / "x.mcap", 1, ignore)


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (["contur"], "unknown scene"),
        (["plane", "--head", "base7"], "stock heads"),
        (["plane", "--preset", "best"], "full, fast, ideal"),
        (["plane", "--patterns", "stripes"], "interleaved"),
        (["plane", "--motion", "jump"], "still, stage, hand"),
    ],
)
def test_wrong_arguments_get_one_line(tmp_path: Path, arguments: list[str], hint: str) -> None:
    ran = CliRunner().invoke(app, ["render", *arguments, "-o", str(tmp_path / "x.mcap")])
    assert ran.exit_code != 0
    assert hint in str(ran.exception)
    assert not (tmp_path / "x.mcap").exists()
