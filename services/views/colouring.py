"""What a cloud's colour says: height, quality, or deviation from the truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d.services.views.colour import coloured, spread
from endo3d.services.views.principal import heights_mm
from endo3d.services.views.scan import xyz

RGBA = ("red", "green", "blue", "alpha")
"""The fields by which Foxglove and Rerun know a point's colour, uint8 each."""


@dataclass(frozen=True)
class Colouring:
    """Values on a ramp."""

    values: NDArray[np.floating]
    """(n,)"""
    low: float
    high: float
    ramp: str
    label: str

    def rgb(self) -> NDArray[np.uint8]:
        """(n, 3)"""
        return coloured(self.values, self.low, self.high, self.ramp)


def by_height(points: NDArray[Any], viewer: NDArray[np.floating]) -> Colouring:
    """Height over the cloud's mean plane, towards the viewer (3,)."""
    values = heights_mm(xyz(points), viewer)
    return Colouring(values, *spread(values), "height", "height / mm")


def by_nearness(points: NDArray[Any]) -> Colouring:
    """Height of a single cloud, camera frame: -z, which costs no fit of a plane at camera rate."""
    values = -points["z"]
    return Colouring(values, *spread(values[:: max(1, len(values) // 4000)]), "height", "-z / mm")


def by_quality(points: NDArray[Any]) -> Colouring:
    """The decoder's quality of a cloud; of a merged map the 1-sigma of a point's mean, green is small."""
    if "quality" in (points.dtype.names or ()):
        return Colouring(points["quality"], 0.0, 1.0, "quality", "quality")
    sigma_um = 1e3 * points["sigma"] / np.sqrt(np.maximum(points["count"], 1))
    return Colouring(sigma_um, *spread(sigma_um)[::-1], "quality", "1-sigma of the merged point / um")


def by_deviation(deviation_um: NDArray[np.floating]) -> Colouring:
    """Signed distance from the truth, white at zero."""
    most = max(-spread(deviation_um)[0], spread(deviation_um)[1])
    return Colouring(deviation_um, -most, most, "deviation", "deviation from truth / um")


def colouring(
    points: NDArray[Any],
    colour: str,
    viewer: NDArray[np.floating],
    deviation_um: NDArray[np.floating] | None = None,
) -> Colouring:
    """By name. Raises ``ValueError`` for deviation without one value per point."""
    if colour == "deviation":
        if deviation_um is None or len(deviation_um) != len(points):
            raise ValueError("colour by deviation needs one deviation_um per point")
        return by_deviation(deviation_um)
    return by_quality(points) if colour == "quality" else by_height(points, viewer)


def visible(points: NDArray[Any], low: float, high: float) -> NDArray[Any]:
    """A copy of structured points with a colour of their own, for viewers that know nothing of endo3d.

    By height towards the first camera, -z, over ``low``..``high`` mm.
    """
    names = points.dtype.names or ()
    coloured_points = np.empty(
        points.shape, [(name, points.dtype[name]) for name in names] + [(name, np.uint8) for name in RGBA]
    )
    for name in names:
        coloured_points[name] = points[name]
    rgb = coloured(-points["z"], low, high, "height")
    for k, name in enumerate(RGBA[:3]):
        coloured_points[name] = rgb[..., k]
    coloured_points["alpha"] = 255
    return coloured_points
