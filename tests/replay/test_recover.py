"""A torn log gives back all that was whole, wherever the tear is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from typer.testing import CliRunner

from endo3d.services.archive.reader import Log, Unreadable
from endo3d.services.archive.recover import is_whole, recover
from endo3d.services.archive.sink import FileSink
from endo3d.services.archive.writer import OWN_CHUNK_BYTES, Kind, Writer
from endo3d.services.cli.app import app
from endo3d.services.runtime.errors import UserError

KIND = Kind("a.Kind", "protobuf", b"definition")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log with images, poses in several chunks, and an attachment in between."""
    path = tmp_path_factory.mktemp("whole") / "log.mcap"
    writer = Writer(FileSink(path), "test")
    writer.attach("early", "text/plain", b"early", 0)
    image, small = writer.channel("/image", KIND, {"crop": "0 0 1 1 2 2"}), writer.channel("/pose", KIND)
    for sequence in range(6):
        writer.put(image, sequence, 10 * sequence, 1, bytes([sequence]) * OWN_CHUNK_BYTES)
        writer.put(small, sequence, 10 * sequence + 1, 2, b"p%d" % sequence)
        if sequence % 2:
            writer.flush()
    writer.attach("late", "text/plain", b"late", 0)
    writer.finish()
    return path


def contents(path: Path) -> list[tuple[str, int, int, int, bytes]]:
    """Every message, by the format's own library, CRCs checked."""
    with path.open("rb") as file:
        return [
            (channel.topic, message.sequence, message.log_time, message.publish_time, message.data)
            for _, channel, message in make_reader(file, validate_crcs=True).iter_messages()
        ]


def surviving(whole: Path, cut: int) -> list[tuple[str, int, int, int, bytes]]:
    """What the chunks hold that end before ``cut``."""
    log = Log(whole)
    kept = [chunk for chunk in log.chunks if chunk.offset + chunk.length <= cut]
    found = []
    for chunk in kept:
        for record in log._in_chunk(chunk, log.streams, check=True):
            found.append((record.stream.name, record.sequence, record.log_ns, record.publish_ns, bytes(record.payload)))
    return sorted(found, key=lambda item: item[2])


@given(st.data())
def test_cut_anywhere(whole: Path, tmp_path: Path, data: st.DataObject) -> None:
    content = whole.read_bytes()
    near = [offset + delta for offset in boundaries(whole) for delta in range(-2, 3)]
    cut = data.draw(st.one_of(st.sampled_from(near), st.integers(9, len(content) - 1)))
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(content[:cut])
    expected = surviving(whole, cut)
    if not expected:
        with pytest.raises(Unreadable, match="no whole message"):
            recover(torn)
        return
    assert not is_whole(torn)
    report = recover(torn)
    assert not report.was_whole
    assert report.messages == len(expected)
    assert contents(torn) == expected
    assert Log(torn).attachments["early"] == b"early"
    assert torn.read_bytes()[: cut - report.lost_bytes] == content[: cut - report.lost_bytes]
    assert recover(torn).was_whole


def boundaries(path: Path) -> list[int]:
    log = Log(path)
    ends = [chunk.offset + chunk.length for chunk in log.chunks]
    return ends + [chunk.offset + chunk.length + chunk.index_length for chunk in log.chunks]


@given(st.integers(0, 5), st.integers(0, OWN_CHUNK_BYTES - 1))
def test_a_flipped_bit_costs_its_chunk_only(whole: Path, tmp_path: Path, image: int, at: int) -> None:
    damaged = tmp_path / "damaged.mcap"
    content = bytearray(whole.read_bytes())
    chunk = [c for c in Log(whole).chunks if c.size > OWN_CHUNK_BYTES][image]
    content[chunk.records_offset + 31 + at] ^= 0x10
    damaged.write_bytes(content)
    with pytest.raises(Unreadable, match="damaged at byte"):
        list(Log(damaged).records())
    report = recover(damaged)
    assert [item for item in contents(whole) if item[:2] != ("/image", image)] == contents(damaged)
    assert [damage.offset for damage in report.damages] == [chunk.offset]
    assert report.damaged_copy is not None
    assert report.damaged_copy.read_bytes() == content
    assert Log(damaged).attachments == {"early": b"early", "late": b"late"}
    assert Log(damaged).streams[1].crop == Log(whole).streams[1].crop is not None


def test_a_damaged_index_is_written_again(whole: Path, tmp_path: Path) -> None:
    damaged = tmp_path / "damaged.mcap"
    content = bytearray(whole.read_bytes())
    content[-100] ^= 1
    damaged.write_bytes(content)
    with pytest.raises(Unreadable, match=r"index of .* is damaged: endo3d recover"):
        Log(damaged)
    assert not recover(damaged).was_whole
    assert damaged.read_bytes() == whole.read_bytes()


@pytest.fixture(scope="module")
def elsewhere(whole: Path) -> list[int]:
    """Offsets of all that is not an image's pixels."""
    pixels = np.zeros(whole.stat().st_size, bool)
    for chunk in Log(whole).chunks:
        if chunk.size > OWN_CHUNK_BYTES:
            pixels[chunk.records_offset + 31 : chunk.records_offset + chunk.size] = True
    return np.flatnonzero(~pixels)[8:].tolist()


@given(st.data())
def test_wherever_a_bit_flips_nothing_wrong_is_read(
    whole: Path, elsewhere: list[int], tmp_path: Path, data: st.DataObject
) -> None:
    """Either it is noticed, and what recover saves is as it was; or it does no harm."""
    content = bytearray(whole.read_bytes())
    at = data.draw(st.sampled_from(elsewhere))
    content[at] ^= 1 << data.draw(st.integers(0, 7))
    path = tmp_path / "flipped.mcap"
    path.write_bytes(content)
    intact = contents(whole)
    try:
        read = list(Log(path).records())
    except Unreadable:
        try:
            recover(path)
        except Unreadable:
            return
        read = list(Log(path).records())
    said = [(r.stream.name, r.sequence, r.log_ns, r.publish_ns, bytes(r.payload)) for r in read]
    assert [item[4] for item in said if item not in intact] == []


def test_into_another_file_the_torn_one_stays(whole: Path, tmp_path: Path) -> None:
    torn, out = tmp_path / "torn.mcap", tmp_path / "out.mcap"
    content = whole.read_bytes()[:-100]
    torn.write_bytes(content)
    recover(torn, out)
    assert torn.read_bytes() == content
    assert contents(out) == contents(whole)


def test_a_log_being_recorded_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "live.mcap"
    writer = Writer(FileSink(path), "test")
    writer.put(writer.channel("/image", KIND), 0, 0, 0, bytes(OWN_CHUNK_BYTES))
    with pytest.raises(Unreadable, match="being recorded"):
        recover(path)
    writer.finish()
    assert recover(path).was_whole


def test_not_a_log(tmp_path: Path) -> None:
    path = tmp_path / "no.mcap"
    with pytest.raises(Unreadable, match="can't open"):
        recover(path)
    path.write_bytes(b"")
    with pytest.raises(Unreadable, match="nothing in it"):
        recover(path)
    path.write_bytes(bytes(1000))
    with pytest.raises(Unreadable, match="not an MCAP log"):
        recover(path)


def test_the_command(whole: Path, tmp_path: Path) -> None:
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(whole.read_bytes()[:-100])
    first = CliRunner().invoke(app, ["recover", str(torn)])
    assert first.exit_code == 0
    assert first.stdout.startswith(f"{torn}: 12 messages in 9 chunks, ")
    again = CliRunner().invoke(app, ["recover", str(torn)])
    assert again.stdout == f"{torn}: nothing to repair, 12 messages\n"
    several = CliRunner().invoke(app, ["recover", str(torn), str(torn), "--out", str(tmp_path / "out.mcap")])
    assert isinstance(several.exception, UserError)
