"""Wrote v0.mcap and v0.desc, once, at the first release: `python tests/schemas/logs/write_v0.py`.

They are not to be written again. When messages have grown, add a `write_v1.py` and its log beside them, so
that what was recorded at any time is decoded by every test run.
"""

from __future__ import annotations

import sys
from pathlib import Path

from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.writer import CompressionType, Writer

from endo3d.schemas import codec, topics

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))

from any_message import example  # noqa: E402

files = {}
with (HERE / "v0.mcap").open("xb") as stream:
    writer = Writer(stream, compression=CompressionType.NONE)
    writer.start(profile="", library="endo3d 0.1.0")
    for topic in topics.TOPICS:
        name, encoding, data = codec.schema(topic)
        files |= {file.name: file for file in FileDescriptorSet.FromString(data).file}
        channel = writer.register_channel(
            topic=topic.channel("decoder"),
            message_encoding=encoding,
            schema_id=writer.register_schema(name=name, encoding=encoding, data=data),
        )
        message = example(topic)
        stamp = message.stamp_ns
        writer.add_message(channel, log_time=stamp, publish_time=stamp, data=codec.encode(message))
    writer.finish()
(HERE / "v0.desc").write_bytes(FileDescriptorSet(file=[files["endo3d.proto"]]).SerializeToString())
