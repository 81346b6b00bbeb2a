"""Only the fibre's image circle is kept of a frame: about 40 % less, for the rest is dark.

The archive's channel says in its metadata what was cut out of what, so that the message stays an ordinary,
smaller image for every viewer, and this program's reader gives frames of the camera's size again. Outside of
the kept rectangle they are zero: what the camera saw there is not kept.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from endo3d.schemas.messages import Frame

MARGIN_PX = 4
"""Kept around the circle: a head's figures are not exact to the pixel."""
KEY = "crop"


@dataclass(frozen=True, slots=True)
class Crop:
    """A rectangle of an image, in pixels."""

    row: int
    column: int
    rows: int
    columns: int
    of_rows: int
    of_columns: int

    @classmethod
    def around_circle(cls, diameter_px: float, rows: int, columns: int) -> Crop:
        """The square about the image's middle that holds a circle, as far as the image goes."""
        side = int(np.ceil(diameter_px)) + 2 * MARGIN_PX
        high, wide = min(rows, side), min(columns, side)
        return cls((rows - high) // 2, (columns - wide) // 2, high, wide, rows, columns)

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> Crop | None:
        """What ``metadata`` wrote; None for a channel of whole images."""
        return cls(*map(int, metadata[KEY].split())) if KEY in metadata else None

    def metadata(self) -> Mapping[str, str]:
        numbers = (self.row, self.column, self.rows, self.columns, self.of_rows, self.of_columns)
        return {KEY: " ".join(map(str, numbers))}

    def cut(self, frame: Frame) -> Frame:
        """The kept part, a view. Raises ``ValueError`` for a frame of another size."""
        if frame.image.shape != (self.of_rows, self.of_columns):
            raise ValueError(f"{frame.image.shape} is not {self.of_rows, self.of_columns}")
        return replace(frame, image=frame.image[self._rectangle])

    def restore(self, frame: Frame) -> Frame:
        """A frame of the camera's size, zero outside of what was kept."""
        image = np.zeros((self.of_rows, self.of_columns), frame.image.dtype)
        image[self._rectangle] = frame.image
        image.flags.writeable = False
        return replace(frame, image=image)

    @property
    def _rectangle(self) -> tuple[slice, slice]:
        return slice(self.row, self.row + self.rows), slice(self.column, self.column + self.columns)
