"""A folder of numbered images, checked: none missing, all alike."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from endo3d.services.devices.grey_image import read_grey
from endo3d.services.runtime.errors import UserError

SUFFIXES = frozenset({".png", ".tif", ".tiff", ".bmp"})


def numbered(folder: Path, pattern: str = "*") -> list[Path]:
    """Images in the order of the last number in their names. Raises ``UserError`` when one is missing."""
    if not folder.is_dir():
        raise UserError(f"{folder} is no folder; name the one with the images and capture.toml")
    found = [path for path in folder.glob(pattern) if path.suffix.lower() in SUFFIXES]
    if not found:
        kinds = ", ".join(sorted(SUFFIXES))
        raise UserError(f"{folder} holds no image {pattern!r} ({kinds}); name the folder with the images")
    by_number: dict[int, Path] = {}
    for path in sorted(found):
        digits = re.findall(r"\d+", path.stem)
        if not digits:
            raise UserError(f"{path.name} has no number in its name; number the images, or choose: images = '...'")
        number = int(digits[-1])
        if number in by_number:
            raise UserError(f"{by_number[number].name} and {path.name} have the same number; choose: images = '...'")
        by_number[number] = path
    numbers = sorted(by_number)
    for expected, number in enumerate(numbers, numbers[0]):
        if number != expected:
            raise UserError(f"image {expected} is missing in {folder}: after {by_number[expected - 1].name} comes "
                            f"{by_number[number].name}; capture it again")  # fmt: skip
    return [by_number[number] for number in numbers]


def images(paths: list[Path], shape: tuple[int, int]) -> Iterator[NDArray[Any]]:
    """(height, width) uint8 or uint16 each; ``shape`` is the calibration's. Raises ``UserError``."""
    first: NDArray[Any] | None = None
    for path in paths:
        try:
            image = read_grey(path)
        except ValueError as error:
            raise UserError(str(error)) from error
        first = image if first is None else first
        if image.shape != first.shape or image.dtype != first.dtype:
            raise UserError(
                f"{path.name} is {_size(image)}, {paths[0].name} is {_size(first)}: all images must be alike"
            )
        if image.shape != shape:
            raise UserError(
                f"{path.name} is {_size(image)}, the calibration's camera {shape[1]}x{shape[0]}; "
                "use the calibration of these images"
            )
        yield image


def _size(image: NDArray[Any]) -> str:
    return f"{image.shape[1]}x{image.shape[0]} of {8 * image.itemsize} bit"
