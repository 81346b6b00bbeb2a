"""Image files as grey values, for whatever takes pictures from a folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


def read_grey(path: Path) -> NDArray[Any]:
    """(height, width) uint8 or uint16; colours become grey. Raises ``ValueError`` that names the file."""
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError(f"{path} can't be read as an image; convert it to png or tif")
    if image.ndim == 3:
        image = cv2.cvtColor(image[..., :3], cv2.COLOR_BGR2GRAY)
    if image.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"{path} has {image.dtype} pixels; 8 or 16 bits are read")
    return image
