"""Read a running rig from your own program, in one line.

from endo3d.services.tap import tap

for cloud in tap("cloud", rig="demo"):
    print(cloud.stamp_ns, cloud.valid_count, cloud.points["z"].shape)
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator

from endo3d.schemas import topics
from endo3d.schemas.messages import Message
from endo3d.schemas.topics import Topic
from endo3d.services.runtime.bus import Bus
from endo3d.services.runtime.errors import UserError


def tap(
    topic: str | Topic,
    *,
    rig: str = "demo",
    latest: bool = True,
    timeout_s: float | None = None,
    port: int | None = None,
) -> Iterator[Message]:
    """The messages of a topic as they come; arrays are read-only views into shared memory.

    latest: a loop that is slower than the rig gets the newest message each time; otherwise up to
    ``topic.depth`` of them wait. timeout_s: end when nothing came for so long; None waits for ever.
    Raises ``UserError`` for an unknown topic, naming the known ones.
    """
    if isinstance(topic, str):
        if topic not in topics.BY_NAME:
            raise UserError(f"no topic {topic!r}; there are: {', '.join(topics.BY_NAME)}")
        topic = topics.BY_NAME[topic]
    waiting: deque[Message] = deque(maxlen=1 if latest else topic.depth)
    came = threading.Condition()

    def take(message: Message) -> None:
        with came:
            waiting.append(message)
            came.notify()

    with Bus.open(rig, name="tap", port=port) as bus:
        bus.subscribe(topic, take)
        while True:
            with came:
                if not came.wait_for(lambda: waiting, timeout_s):
                    return
                message = waiting.popleft()
            yield message
