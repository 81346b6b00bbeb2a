"""Scenes by a short text: bodies joined by ``+``, each ``kind key=value ...``.

    plane z=20                          tilted: plane tilt=20 (deg, about y) or tilt=20,10 (about y, then x)
    sphere r=1 at=0,0,20
    cylinder r=1 at=0,0,20              its axis along y; the half that faces the sensor
    steps heights=0.05/0.1/0.2/0.5 width=1.5
    contour                             the micro-contour standard of the paper
    blade size=1                        a freeform surface like a turbine blade's, 10 mm of chord
    board print=checkerboard,9x7,pitch=1    a printed calibration board: ``Board.parse``, with commas
    mesh file=part.stl scale=1          any STL or PLY mesh, in mm; z points away from the sensor
    sphere r=1 at=0,0,19 + plane z=20

Of every body: ``at=x,y,z`` (mm, in the camera's axes at time 0; z defaults to the working distance),
``turn=a,b,c`` (rotation vector, deg), ``albedo=0.7``, ``texture=noise:0.15`` or ``noise:0.15:0.3``
(contrast, size in mm), ``texture=checker:0.5:1``, ``surface=metal``, ``specular=``, ``gloss=``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from endo3d_core.calibrating.boards import Board
from endo3d_core.virtual_rig import freeform, mesh
from endo3d_core.virtual_rig.board import Print
from endo3d_core.virtual_rig.contour_standard import contour_standard
from endo3d_core.virtual_rig.material import METAL, Material, Texture
from endo3d_core.virtual_rig.mesh import Mesh
from endo3d_core.virtual_rig.motion import transform
from endo3d_core.virtual_rig.profile import Contour, Profile
from endo3d_core.virtual_rig.words import Words

PLANE_REACH_MM = 200.0


@dataclass(frozen=True)
class Sphere:
    """About the body's origin."""

    radius_mm: float


@dataclass(frozen=True, eq=False)
class Freeform:
    """A surface over the body's x and y."""

    parameters: NDArray[np.float64]
    """As ``freeform.blade`` makes them."""


Shape = Profile | Sphere | Freeform | Mesh


@dataclass(frozen=True, eq=False)
class Body:
    """A shape in the scene."""

    kind: str
    shape: Shape
    material: Material
    T_scene_body: NDArray[np.float64]
    """(4, 4), mm."""


@dataclass(frozen=True, eq=False)
class Scene:
    """What the sensor looks at. The scene's axes are the camera's at time 0."""

    text: str
    bodies: tuple[Body, ...]


KINDS = ("plane", "sphere", "cylinder", "steps", "contour", "blade", "board", "mesh")


def parse(text: str, working_distance_mm: float = 20.0) -> Scene:
    """Text -> scene. Raises ``ValueError`` that says what is wrong and what would be right."""
    return Scene(text, tuple(_body(part.strip(), working_distance_mm) for part in text.split("+")))


def _body(text: str, working_distance_mm: float) -> Body:
    words = Words.parse(text, "scene")
    shape = _shape(words)
    at = words.vector("at", (0.0, 0.0, words.number("z", working_distance_mm)))
    turn = np.radians(words.vector("turn", (0.0, 0.0, 0.0)))
    T = transform(at, turn)
    if words.kind == "plane":
        tilt = words.values.get("tilt", "0")
        angles = words.vector("tilt", (0.0, 0.0)) if "," in tilt else np.array((words.number("tilt", 0.0), 0.0))
        a, b = np.radians(angles)
        T = T @ transform(np.zeros(3), np.array((0.0, a, 0.0))) @ transform(np.zeros(3), np.array((b, 0.0, 0.0)))
    material = _material(words)
    words.finish()
    return Body(words.kind, shape, material, T)


def _shape(words: Words) -> Shape:
    match words.kind:
        case "plane" | "board":
            return Contour(-PLANE_REACH_MM, 0.0).line(PLANE_REACH_MM, 0.0).profile()
        case "sphere":
            return Sphere(_positive(words, "r", 1.0))
        case "cylinder":
            radius = _positive(words, "r", 1.0)
            return Contour(-radius, 0.0).cylinder(radius, 90.0).profile()
        case "steps":
            return _steps(words.numbers("heights", (0.05, 0.1, 0.2, 0.5)), _positive(words, "width", 1.5))
        case "contour":
            return contour_standard().profile()
        case "blade":
            return Freeform(freeform.blade(_positive(words, "size", 1.0)))
        case "mesh":
            path = words.text_of("file", "")
            if not path:
                raise ValueError("scene 'mesh' needs file=PART.stl (or .ply), without blanks in its name")
            return mesh.load(Path(path), _positive(words, "scale", 1.0))
        case _:
            raise ValueError(f"unknown scene {words.kind!r}; it is one of: {', '.join(KINDS)}")


def _steps(heights_mm: tuple[float, ...], width_mm: float) -> Profile:
    """A step gauge: rectangular lands of the given heights, each followed by a groove at height 0."""
    total = (2 * len(heights_mm) + 1) * width_mm
    x = -total / 2
    contour = Contour(x, 0.0)
    for height in heights_mm:
        contour.line(x + width_mm, 0.0).line(x + width_mm, height).line(x + 2 * width_mm, height)
        contour.line(x + 2 * width_mm, 0.0)
        x += 2 * width_mm
    return contour.line(total / 2, 0.0).profile()


def _positive(words: Words, key: str, default: float) -> float:
    value = words.number(key, default)
    if not value > 0.0:
        raise ValueError(f"scene {words.kind!r}: {key}={value:g} must be positive")
    return value


def _material(words: Words) -> Material:
    surface = words.text_of("surface", "matt")
    if surface not in ("matt", "metal"):
        raise ValueError(f"scene {words.kind!r}: surface={surface} is not matt or metal")
    base = METAL if surface == "metal" else {"albedo": 0.7, "specular": 0.0, "gloss": 30.0}
    albedo = words.number("albedo", base["albedo"])
    if not 0.0 < albedo <= 1.0:
        raise ValueError(f"scene {words.kind!r}: albedo={albedo:g} must lie in 0..1")
    return Material(
        albedo,
        _print(words) if words.kind == "board" else _texture(words.kind, words.text_of("texture", "none")),
        words.number("specular", base["specular"]),
        words.number("gloss", base["gloss"]),
    )


def _print(words: Words) -> Texture:
    board = Board.parse(words.text_of("print", "checkerboard,11x9,pitch=0.8").replace(",", " "))
    return Print(text=board.text)


def _texture(kind: str, text: str) -> Texture:
    name, *numbers = text.split(":")
    try:
        values = [float(number) for number in numbers]
    except ValueError:
        values = [math.nan]
    if name == "none" and not values:
        return Texture()
    if name in ("noise", "checker") and 1 <= len(values) <= 2 and 0.0 < values[0] < 1.0 and min(values) > 0.0:
        return Texture(name, values[0], values[1] if len(values) == 2 else (0.15 if name == "noise" else 1.0))
    raise ValueError(
        f"scene {kind!r}: texture={text} is not none, noise:CONTRAST[:SIZE_MM] or checker:CONTRAST[:SIZE_MM]"
    )
