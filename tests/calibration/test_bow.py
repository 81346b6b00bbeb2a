"""The flat reference's correction: it finds a bend that was put in, leaves planes alone, costs nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endo3d.services.evaluation.virtual_run import head_yaml
from endo3d_core import triangulation
from endo3d_core.bow import POWERS, Bow
from endo3d_core.calibrating.flat_reference import Flat, fit, flatness_um
from endo3d_core.calibration import Rig

RIG = Rig.from_yaml(head_yaml("base6_wd20"))
BENT = Bow(0.05, tuple(1e-4 * np.cos(1.7 * np.arange(len(POWERS)))))
LINE = np.linspace(-0.28, 0.28, 30)


def plane(z: float, slope_x: float, slope_y: float, bow: Bow) -> Flat:
    """A plane as a rig measures it that would need ``bow``, by fixed-point iteration."""
    x, y = (a.ravel() for a in np.meshgrid(LINE, LINE))
    true = (1.0 - slope_x * x - slope_y * y) / z
    q = true.copy()
    for _ in range(20):
        q = true - bow(x, y, q)
    return Flat(f"{z}", x, y, q)


def test_a_bend_is_found_from_three_planes_and_a_fourth_becomes_flat() -> None:
    flats = [plane(17.5, 0.1, 0.0, BENT), plane(20.0, -0.1, 0.08, BENT), plane(22.5, 0.0, -0.1, BENT)]
    found = fit(flats)
    other = plane(19.0, 0.05, 0.15, BENT)
    assert np.std(flatness_um(other, Bow())) > 1.0
    assert np.abs(flatness_um(other, found)).max() < 0.05


def test_true_planes_need_no_correction() -> None:
    found = fit([plane(18.0, 0.2, 0.1, Bow()), plane(22.0, -0.2, 0.1, Bow())])
    x, y = np.meshgrid(LINE, LINE)
    assert np.abs(found(x, y, 0.05)).max() < 1e-9


def test_the_lookup_carries_the_correction() -> None:
    bent = replace(RIG, bow=BENT)
    lookup = triangulation.build(replace(bent, camera=bent.camera.binned(4)), 4, 17.0, 23.0)
    straight = triangulation.build(replace(RIG, camera=RIG.camera.binned(4)), 4, 17.0, 23.0)
    assert lookup.planes.shape == straight.planes.shape  # not a value more per pixel
    pixels = np.array([[700.0, 400.0], [960.0, 600.0], [1300.0, 800.0]])
    coordinate = RIG.projector_pixel(RIG.camera.ray(pixels) * 20.0)[:, 0]
    before = triangulation.exact_depth(RIG, pixels, coordinate, 20.0)
    after = triangulation.exact_depth(bent, pixels, coordinate, 20.0)
    rays = RIG.camera.ray(pixels)
    np.testing.assert_allclose(1 / after - 1 / before, BENT(rays[:, 0], rays[:, 1], 1 / before), atol=1e-12)


def test_it_survives_the_file() -> None:
    text = replace(RIG, bow=BENT).to_yaml()
    back = Rig.from_yaml(text)
    assert back.bow.coefficients == BENT.coefficients
    assert back.to_yaml() == text
    with pytest.raises(ValueError, match="flat_reference needs"):
        Rig.from_yaml(text.replace("inverse_depth", "depth"))
