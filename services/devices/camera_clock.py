"""A camera's own clock, translated to the rig's."""

from __future__ import annotations

DRIFT_PPM = 100
"""How much two crystals may differ."""


class CameraClock:
    """Stamps of a free-running camera clock -> ns of the rig's clock.

    Best is a latch: both clocks read at once. Without it, the quickest transfer seen tells the least possible
    delay; what a transfer always takes stays in, so slots are anchored by the images then.
    """

    def __init__(self) -> None:
        self._offset_ns: int | None = None
        self._latched = False
        self._seen_ns = 0

    def latch(self, camera_ns: int, before_ns: int, after_ns: int) -> None:
        """The camera's clock was read between two readings of the rig's."""
        self._offset_ns, self._latched = (before_ns + after_ns) // 2 - camera_ns, True

    def arrived(self, camera_ns: int, arrived_ns: int) -> None:
        """An image with this stamp arrived then."""
        if self._latched:
            return
        offset_ns = arrived_ns - camera_ns
        if self._offset_ns is not None:
            may_drift_ns = max(0, arrived_ns - self._seen_ns) * DRIFT_PPM // 1_000_000
            offset_ns = min(offset_ns, self._offset_ns + may_drift_ns)
        self._offset_ns, self._seen_ns = offset_ns, arrived_ns

    def rig_ns(self, camera_ns: int) -> int:
        """Raises ``RuntimeError`` before a first latch or arrival."""
        if self._offset_ns is None:
            raise RuntimeError("no stamp of this camera has been seen")
        return camera_ns + self._offset_ns
