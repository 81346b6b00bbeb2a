"""The calibrated sensor: two lenses and how they stand to each other.

Terms and file are OpenCV's. Pixel (0, 0) is the centre of the first pixel. A point of the camera's axes (mm)
has X_projector = R X_camera + t. The calibration file is plain YAML; sections it does not know (``head``) are
left to others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml
from numpy.typing import ArrayLike, NDArray

from endo3d_core import brown_conrady
from endo3d_core.bow import NO_BOW, SECTION, Bow
from endo3d_core.compiled import exact


@exact
def _each_point(
    x: NDArray[np.float64], y: NDArray[np.float64], dist: NDArray[np.float64], inverse: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    out_x, out_y = np.empty_like(x), np.empty_like(y)
    for i in range(x.size):
        if inverse:
            out_x[i], out_y[i] = brown_conrady.undistort(x[i], y[i], dist)
        else:
            out_x[i], out_y[i] = brown_conrady.distort(x[i], y[i], dist)
    return out_x, out_y


def _mapped(
    x: ArrayLike, y: ArrayLike, dist: NDArray[np.float64], inverse: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x64, y64 = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
    mapped = _each_point(x64.ravel(), y64.ravel(), dist, inverse)
    return mapped[0].reshape(x64.shape), mapped[1].reshape(x64.shape)


@dataclass(frozen=True, eq=False)
class Lens:
    """A pinhole with Brown-Conrady distortion: of the camera, or of the projector seen as an inverse
    camera."""

    width: int
    height: int
    K: NDArray[np.float64]
    """(3, 3), pixels."""
    dist: NDArray[np.float64]
    """(5,) k1 k2 p1 p2 k3."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "K", np.ascontiguousarray(self.K, np.float64).reshape(3, 3))
        object.__setattr__(self, "dist", np.ascontiguousarray(self.dist, np.float64).reshape(5))
        if self.width < 1 or self.height < 1:
            raise ValueError(f"a lens needs a positive width and height, not {self.width} x {self.height}")
        if not (self.K[0, 0] > 0 and self.K[1, 1] > 0 and np.all(self.K[2] == (0, 0, 1)) and self.K[1, 0] == 0):
            raise ValueError("K must be [[fx, skew, cx], [0, fy, cy], [0, 0, 1]] with positive fx and fy")

    def project(self, points: ArrayLike) -> NDArray[np.float64]:
        """(..., 3) points of this lens's axes, mm -> (..., 2) pixels; NaN behind the lens."""
        p = np.asarray(points, np.float64)
        z = np.where(p[..., 2] > 0, p[..., 2], np.nan)
        return self.to_pixels(p[..., 0] / z, p[..., 1] / z)

    def to_pixels(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.float64]:
        """Ideal normalised coordinates -> (..., 2) distorted pixels."""
        xd, yd = _mapped(x, y, self.dist, inverse=False)
        return np.stack(
            (self.K[0, 0] * xd + self.K[0, 1] * yd + self.K[0, 2], self.K[1, 1] * yd + self.K[1, 2]), axis=-1
        )

    def undistort(self, pixels: ArrayLike) -> NDArray[np.float64]:
        """(..., 2) pixels -> (..., 2) ideal normalised coordinates (X/Z, Y/Z)."""
        uv = np.asarray(pixels, np.float64)
        yd = (uv[..., 1] - self.K[1, 2]) / self.K[1, 1]
        xd = (uv[..., 0] - self.K[0, 2] - self.K[0, 1] * yd) / self.K[0, 0]
        return np.stack(_mapped(xd, yd, self.dist, inverse=True), axis=-1)

    def ray(self, pixels: ArrayLike) -> NDArray[np.float64]:
        """(..., 2) pixels -> (..., 3) viewing rays with z = 1: a point at depth z is z times its ray."""
        xy = self.undistort(pixels)
        return np.concatenate((xy, np.ones_like(xy[..., :1])), axis=-1)

    def pixel_grid(self) -> NDArray[np.float64]:
        """(height, width, 2) centres of all pixels."""
        u, v = np.meshgrid(np.arange(self.width, dtype=np.float64), np.arange(self.height, dtype=np.float64))
        return np.stack((u, v), axis=-1)

    def binned(self, bin_px: int) -> Lens:
        """The same lens on a grid whose cells are means of ``bin_px`` x ``bin_px`` pixels."""
        K = self.K.copy()
        K[:2] /= bin_px
        K[:2, 2] += 0.5 / bin_px - 0.5
        return Lens(self.width // bin_px, self.height // bin_px, K, self.dist)


@dataclass(frozen=True, eq=False)
class Rig:
    """Camera, projector and the transform between them."""

    camera: Lens
    projector: Lens
    R: NDArray[np.float64]
    """(3, 3)."""
    t: NDArray[np.float64]
    """(3,) mm: X_projector = R X_camera + t."""
    bow: Bow = NO_BOW
    """What the lenses' model misses by, seen on a flat reference."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "R", np.ascontiguousarray(self.R, np.float64).reshape(3, 3))
        object.__setattr__(self, "t", np.ascontiguousarray(self.t, np.float64).reshape(3))
        if not np.allclose(self.R @ self.R.T, np.eye(3), atol=1e-6) or np.linalg.det(self.R) < 0:
            raise ValueError("R is not a rotation")

    @property
    def T_projector_camera(self) -> NDArray[np.float64]:
        """(4, 4), mm."""
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.R, self.t
        return T

    @property
    def projector_centre_mm(self) -> NDArray[np.float64]:
        """(3,) in the camera's axes."""
        return np.asarray(-self.R.T @ self.t)

    def to_projector(self, points: ArrayLike) -> NDArray[np.float64]:
        """(..., 3) points of the camera's axes -> the projector's axes, mm."""
        return np.asarray(np.asarray(points, np.float64) @ self.R.T + self.t)

    def projector_pixel(self, points: ArrayLike) -> NDArray[np.float64]:
        """(..., 3) points of the camera's axes, mm -> (..., 2) projector pixels that light them."""
        return self.projector.project(self.to_projector(points))

    @classmethod
    def from_yaml(cls, text: str) -> Rig:
        """Parse a calibration file's text. Raises ``ValueError`` that names what is missing or wrong."""
        try:
            tree = yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise ValueError(f"the calibration is not YAML: {str(error).splitlines()[0]}") from error
        if not isinstance(tree, Mapping):
            raise ValueError("the calibration needs the sections camera, projector, R and t")
        camera = _section(tree, "camera", lambda value: _lens(value, "camera"))
        projector = _section(tree, "projector", lambda value: _lens(value, "projector"))
        R = _section(tree, "R", lambda value: _numbers(value, 9, "R"))
        t = _section(tree, "t", lambda value: _numbers(value, 3, "t"))
        return cls(camera, projector, R.reshape(3, 3), t, Bow.from_tree(tree.get(SECTION)))

    def to_yaml(self) -> str:
        """The calibration file's text; ``from_yaml`` gives back the same numbers to the last bit."""
        lines: list[str] = []
        for name, lens in (("camera", self.camera), ("projector", self.projector)):
            lines += [f"{name}:", f"  width: {lens.width}", f"  height: {lens.height}"]
            lines += [f"  K: {_text(lens.K)}", f"  dist: {_text(lens.dist)}"]
        lines += [f"R: {_text(self.R)}", f"t: {_text(self.t)}"]
        if self.bow.coefficients:
            lines += [f"{SECTION}:", f"  inverse_depth: {_number(self.bow.inverse_depth)}"]
            lines += [f"  coefficients: {_text(np.array(self.bow.coefficients))}"]
        return "\n".join([*lines, ""])


def _section(tree: Mapping[str, Any], name: str, parse: Callable[[Any], Any]) -> Any:
    if name not in tree:
        raise ValueError(f"the calibration has no {name!r}; it needs camera, projector, R and t")
    return parse(tree[name])


def _lens(section: Any, name: str) -> Lens:
    required = ("width", "height", "K", "dist")
    missing = [key for key in required if not isinstance(section, Mapping) or key not in section]
    if missing:
        raise ValueError(f"the calibration's {name} has no {missing[0]!r}; it needs {', '.join(required)}")
    K = _numbers(section["K"], 9, f"{name}.K").reshape(3, 3)
    return Lens(int(section["width"]), int(section["height"]), K, _numbers(section["dist"], 5, f"{name}.dist"))


def _numbers(value: Any, count: int, name: str) -> NDArray[np.float64]:
    """A nested or flat list, or OpenCV's own ``{rows, cols, data}``."""
    try:
        numbers = np.asarray(value["data"] if isinstance(value, Mapping) else value, np.float64).ravel()
    except (TypeError, ValueError, KeyError) as error:
        raise ValueError(f"the calibration's {name} must be {count} numbers") from error
    if numbers.size != count or not np.all(np.isfinite(numbers)):
        raise ValueError(f"the calibration's {name} must be {count} finite numbers, got {numbers.size}")
    return numbers


def _text(array: NDArray[np.float64]) -> str:
    """Flow-style YAML list; repr keeps every bit, and YAML 1.1 wants a dot before an exponent."""
    if array.ndim == 2:
        return "[" + ", ".join(_text(row) for row in array) + "]"
    return "[" + ", ".join(_number(float(value)) for value in array) + "]"


def _number(value: float) -> str:
    text = repr(value)
    mantissa, exponent, power = text.partition("e")
    return f"{mantissa}.0e{power}" if exponent and "." not in mantissa else text
