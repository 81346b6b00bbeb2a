"""What the writer writes, the format's own library reads; what others wrote, the log reader reads."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as LibraryWriter
from recorded import pose, same

from endo3d.schemas import codec, topics
from endo3d.services.archive.reader import Log, Unreadable
from endo3d.services.archive.sink import _after, file_sink
from endo3d.services.archive.writer import OWN_CHUNK_BYTES, Kind, Writer

KINDS = (Kind("one.Kind", "protobuf", b"definition"), Kind("other.Kind", "json", b""))
puts = st.lists(
    st.tuples(
        st.integers(0, 4),  # channel
        st.integers(0, 50),  # log time
        st.one_of(st.integers(0, 200), st.integers(OWN_CHUNK_BYTES - 1, OWN_CHUNK_BYTES + 1)),  # size
        st.booleans(),  # flush afterwards
    ),
    max_size=30,
)


@given(puts)
def test_the_library_reads_what_was_put(tmp_path: Path, items: list[tuple[int, int, int, bool]]) -> None:
    path = tmp_path / "log.mcap"
    writer = Writer(file_sink(path), "test")
    expected = []
    for sequence, (channel, log_ns, size, flush) in enumerate(items):
        payload = bytes([sequence]) * size
        kind = KINDS[channel % 2]
        writer.put(writer.channel(f"/{channel}", kind), sequence, log_ns, 7, payload[:10], payload[10:])
        expected.append((log_ns, sequence, f"/{channel}", kind.name, payload))
        if flush:
            writer.flush()
    writer.attach("file", "text/plain", b"content", 3)
    writer.note("facts", {"a": "b"})
    writer.finish()

    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        read = [
            (message.log_time, message.sequence, channel.topic, schema.name if schema else "", message.data)
            for schema, channel, message in reader.iter_messages()
        ]
        statistics = reader.get_summary().statistics
        assert [(a.name, a.data) for a in reader.iter_attachments()] == [("file", b"content")]
        assert [(m.name, m.metadata) for m in reader.iter_metadata()] == [("facts", {"a": "b"})]
    assert Counter(read) == Counter(expected)
    assert [log_ns for log_ns, *_ in read] == sorted(log_ns for log_ns, *_ in expected)
    assert statistics.message_count == len(expected)
    assert Counter(statistics.channel_message_counts.values()).total() == len({e[2] for e in expected})

    log = Log(path)
    ours = [(r.log_ns, r.sequence, r.stream.name, r.stream.schema, bytes(r.payload)) for r in log.records()]
    assert Counter(ours) == Counter(expected)
    assert [log_ns for log_ns, *_ in ours] == sorted(log_ns for log_ns, *_ in expected)
    assert log.attachments == {"file": b"content"}
    assert log.facts == {"facts": {"a": "b"}}


def test_large_messages_have_chunks_of_their_own_and_small_ones_share(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    writer = Writer(file_sink(path), "test")
    image, small = writer.channel("/image", KINDS[0]), writer.channel("/pose", KINDS[0])
    for sequence in range(5):
        writer.put(image, sequence, sequence, 0, bytes(OWN_CHUNK_BYTES))
        writer.put(small, sequence, sequence, 0, b"pose")
    writer.finish()
    log = Log(path)
    held = Counter(tuple(sorted(chunk.index_offsets)) for chunk in log.chunks)
    assert held == {(image,): 5, (small,): 1}


@given(st.lists(st.binary(max_size=6), min_size=1, max_size=5), st.integers(0, 30))
def test_a_write_that_stopped_anywhere_goes_on_there(parts: list[bytes], written: int) -> None:
    whole = b"".join(parts)
    written = min(written, len(whole))
    assert b"".join(_after(tuple(parts), written)) == whole[written:]


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("chunking", [200, 1 << 20])
def test_logs_of_the_library_are_read(tmp_path: Path, compression: CompressionType, chunking: int) -> None:
    path = tmp_path / "foreign.mcap"
    schema = codec.schema(topics.POSE)
    poses = [pose(sequence) for sequence in range(20)]
    with path.open("wb") as file:
        writer = LibraryWriter(file, chunk_size=chunking, compression=compression)
        writer.start()
        kind = writer.register_schema(schema.name, schema.encoding, schema.data)
        channel = writer.register_channel("/pose", "protobuf", kind)
        strange = writer.register_channel("/strange", "json", 0)
        for item in poses:
            writer.add_message(channel, item.stamp_ns, codec.encode(item), item.stamp_ns, item.sequence)
            writer.add_message(strange, item.stamp_ns, b"{}", item.stamp_ns)
        writer.finish()
    log = Log(path)
    assert all(same(left, right) for left, right in zip(log.messages(topics.POSE), poses, strict=True))
    assert [same(left, right) for left, right in zip(log.messages(), poses, strict=True)] == [True] * 20
    unknown = [record for record in log.records() if record.stream.topic is None]
    assert len(unknown) == 20
    with pytest.raises(Unreadable, match="strange"):
        unknown[0].message()


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"", "empty"),
        (b"x", "not an MCAP log"),
        (bytes(1000), "not an MCAP log"),
        (b"\x89MCAP0\r\n" + bytes(1000), "not closed.*endo3d recover"),
        (b"\x89MCAP0\r\n" + bytes(1000) + b"\x89MCAP0\r\n", "no index.*endo3d recover"),
        (None, "can't read"),
    ],
)
def test_a_file_that_is_no_log_says_so(tmp_path: Path, content: bytes | None, complaint: str) -> None:
    path = tmp_path / "no.mcap"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(Unreadable, match=complaint):
        Log(path)


def test_a_window_of_time(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    writer = Writer(file_sink(path), "test")
    channel = writer.channel("/x", KINDS[0])
    for log_ns in (5, 1, 3, 2, 4):
        writer.put(channel, log_ns, log_ns, 0, b"")
    writer.finish()
    assert [record.log_ns for record in Log(path).records(start_ns=2, end_ns=5)] == [2, 3, 4]
