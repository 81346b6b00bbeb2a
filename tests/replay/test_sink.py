"""A log's bytes stand in the file as they were given, also past the kernel's cache and after a step back."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from endo3d.services.archive import sink as sinks
from endo3d.services.archive.sink import DirectSink, FileSink, Sink, file_sink

BLOCK = sinks.BLOCK_BYTES
sizes = st.one_of(st.integers(0, 300), st.sampled_from([BLOCK - 1, BLOCK, BLOCK + 1, 5 * BLOCK + 7, 9 * BLOCK]))
steps = st.lists(st.one_of(st.lists(sizes, max_size=3), st.floats(0, 1)), max_size=12)
"""Parts to write, or how far to cut back."""


def direct(path: Path) -> Sink:
    opened = file_sink(path)
    if not isinstance(opened, DirectSink):
        opened.close()
        pytest.skip("this file system always caches")
    return opened


@pytest.mark.parametrize("open_sink", [FileSink, direct])
@given(script=steps)
def test_a_sink_is_its_file(tmp_path: Path, open_sink: Callable[[Path], Sink], script: list[list[int] | float]) -> None:
    path, expected = tmp_path / "log", bytearray()
    opened = open_sink(path)
    for number, step in enumerate(script):
        if isinstance(step, float):
            del expected[round(step * len(expected)) :]
            opened.truncate(len(expected))
        else:
            parts = [bytes([65 + number]) * size for size in step]
            opened.write(*parts)
            expected += b"".join(parts)
        so_far = path.read_bytes()  # what a kill would leave
        behind = so_far[len(expected) :]
        assert so_far.startswith(expected)
        assert len(behind) <= BLOCK
        assert not any(behind)
    opened.close()
    assert path.read_bytes() == bytes(expected)


def test_more_than_the_stage_holds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sinks, "STAGE_BYTES", 2 * BLOCK)
    content = bytes(range(256)) * 100
    opened = direct(tmp_path / "log")
    opened.write(b"head", content, b"tail")
    opened.close()
    assert (tmp_path / "log").read_bytes() == b"head" + content + b"tail"
