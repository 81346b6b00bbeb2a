"""Logs of every version stay readable: bit for bit what was recorded, nearly the same what is computed of it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from write_kept_logs import LOGS, contents, decoded

KEPT = sorted(LOGS.glob("*/*.mcap"))


def test_there_are_kept_logs() -> None:
    assert {path.stem for path in KEPT} == {"scan", "packed"}


@pytest.mark.parametrize("path", KEPT, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_what_was_recorded_is_read_to_the_bit(path: Path) -> None:
    assert contents(path) == json.loads(path.with_suffix(".json").read_text())


@pytest.mark.parametrize("folder", sorted(LOGS.iterdir()), ids=lambda folder: folder.name)
def test_what_is_computed_of_it_is_the_same(folder: Path) -> None:
    """The same bits on the same machine; on another one, or by a later decoder, within 20 um and 10 % of points.

    Since it was written, the decoder also masks the rim of the projector's disc: 15 % of the points of these frames.
    """
    then = json.loads((folder / "decoded.json").read_text())
    now = decoded(folder / "scan.mcap")
    assert now == decoded(folder / "scan.mcap")
    assert set(then["sequences"]) <= set(now["sequences"])
    at = [now["sequences"].index(sequence) for sequence in then["sequences"]]
    assert [now["median_z_mm"][i] for i in at] == pytest.approx(then["median_z_mm"], abs=0.020)
    assert [now["valid"][i] for i in at] == pytest.approx([0.85 * count for count in then["valid"]], rel=0.1)
