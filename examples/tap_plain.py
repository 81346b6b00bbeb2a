"""Prints the camera images of a running rig with nothing but zenoh and Foxglove's protobuf package."""

import json
import sys
import zlib

import zenoh
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

rig = sys.argv[1] if len(sys.argv) > 1 else "demo"
# A rig's processes meet at sixteen loopback ports that follow from its name.
port = 20_000 + 16 * (zlib.crc32(rig.encode()) % 798)
settings = {
    "connect/endpoints": [f"tcp/127.0.0.1:{port + i}" for i in range(16)],
    "connect/exit_on_failure": False,
    "listen/endpoints": ["tcp/127.0.0.1:0"],
    "scouting/multicast/enabled": False,
}
config = zenoh.Config()
for path, value in settings.items():
    config.insert_json5(path, json.dumps(value))

with zenoh.open(config) as session:
    frames = session.declare_subscriber(f"endo3d/{rig}/frame", zenoh.handlers.RingChannel(2))
    for sample in frames:
        image = RawImage.FromString(sample.payload.to_bytes())
        print(f"{image.width} x {image.height} {image.encoding}, {len(image.data)} bytes", flush=True)
