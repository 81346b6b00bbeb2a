"""Microseconds per message between a message and its bytes, beside the protobuf library in the same run.

    python -m bench.codec

"in place": the array already stands in the slot, as a loaned one does; "encode" copies it; "library":
Foxglove's stock class with the same content. Goal: 10 us in place and to decode, whatever the array's size.
"""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter_ns

import numpy as np
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

from endo3d.schemas import codec, topics
from endo3d.schemas.messages import POINT, Cloud, DepthMap, Frame
from endo3d.schemas.topics import Topic

ROUNDS = 2000
COPYING_ROUNDS = 100
STAMP_NS = 1_760_000_000_123_456_789
PATTERN_SET = "interleaved f1=25"


def microseconds(work: Callable[[], object], rounds: int) -> np.ndarray:
    """(rounds,) float64, after a tenth as many to warm up."""
    for _ in range(rounds // 10):
        work()
    took = np.empty(rounds)
    for at in range(rounds):
        began_ns = perf_counter_ns()
        work()
        took[at] = (perf_counter_ns() - began_ns) / 1e3
    return took


def messages() -> dict[Topic, Frame | Cloud | DepthMap]:
    """A 2.3 MB image, 100 000 points, a depth map of the decoder's usual grid."""
    rng = np.random.default_rng(1)
    image = rng.integers(0, 256, (1200, 1920), np.uint8)
    points = np.zeros((250, 400), POINT)
    depth = rng.integers(0, 65536, (300, 480), np.uint16)
    return {
        topics.FRAME: Frame(STAMP_NS, 1, image, PATTERN_SET, 7, 3, 5200.0, STAMP_NS, 9),
        topics.CLOUD: Cloud(STAMP_NS, 1, points, 25, STAMP_NS, 3, PATTERN_SET, 4.0, 99_000),
        topics.DEPTH: DepthMap(STAMP_NS, 1, depth, 0.0005, 5.0, 4.0),
    }


def main() -> None:
    columns = ("encode in place", "decode", "encode", "library encode", "library decode")
    print(f"{'us, median (99 %)':18}" + "".join(f"{column:>18}" for column in columns))
    for topic, message in messages().items():
        slot = np.zeros(codec.encoded_size(message), np.uint8)
        codec.encode_into(message, slot)
        lent = codec.decode(topic, slot)
        encoded = codec.encode(message)
        stock = PointCloud if topic is topics.CLOUD else RawImage
        header = stock.FromString(encoded)
        header.ClearField("data")
        array = np.asarray(codec.array_of(message))

        def encode_by_library(header=header, array=array):
            proto = type(header)()
            proto.CopyFrom(header)
            proto.data = array.tobytes()
            return proto.SerializeToString()

        def decode_by_library(stock=stock, encoded=encoded, array=array):
            proto = stock.FromString(encoded)
            return np.frombuffer(proto.data, array.dtype)

        took = (
            microseconds(lambda lent=lent, slot=slot: codec.encode_into(lent, slot), ROUNDS),
            microseconds(lambda topic=topic, slot=slot: codec.decode(topic, slot), ROUNDS),
            microseconds(lambda message=message: codec.encode(message), COPYING_ROUNDS),
            microseconds(encode_by_library, COPYING_ROUNDS),
            microseconds(decode_by_library, COPYING_ROUNDS),
        )
        cells = (f"{np.median(us):.1f} ({np.percentile(us, 99):.0f})" for us in took)
        print(
            f"{topic.name:6}{len(encoded) / 1e6:9.2f} MB" + "".join(f"{cell:>18}" for cell in cells),
            flush=True,
        )


if __name__ == "__main__":
    main()
