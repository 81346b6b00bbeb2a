"""Where features are, and which projector pixel lights them: against the virtual rig's truth, fibres on."""

from __future__ import annotations

import numpy as np
import pytest

from endo3d.services.calibration.virtual import COLUMNS, ROWS, VirtualCapture
from endo3d.services.evaluation.virtual_run import head_yaml
from endo3d_core.calibrating.boards import Board
from endo3d_core.calibrating.retina import FibreRetina
from endo3d_core.calibrating.seeing import sight, view
from endo3d_core.calibration import Rig
from endo3d_core.fibre import CoreMap
from endo3d_core.virtual_rig import scene as scenes
from endo3d_core.virtual_rig.board import T_body_board

HEAD = head_yaml("base6_wd20")
BOARD = Board.parse("charuco 11x9 pitch=1.1 marker=0.85")


@pytest.fixture(scope="module")
def virtual() -> VirtualCapture:
    return VirtualCapture(HEAD, BOARD)


def test_features_are_found_through_both_fibres(virtual: VirtualCapture) -> None:
    scene = f"board print={BOARD.text.replace(' ', ',')} at=0.3,-0.2,20 turn=12,-9,5"
    white = np.mean(virtual.whites()[:4], axis=0)
    retina = FibreRetina(CoreMap.find(white))
    sides = [virtual.side(scene, text) for text in (COLUMNS, ROWS)]
    seen = view("pose", retina, (sides[0][0](), sides[0][1]), (sides[1][0](), sides[1][1]), (960, 960))
    sighting = sight(seen, BOARD, retina)
    rig = Rig.from_yaml(HEAD)
    T = scenes.parse(scene).bodies[0].T_scene_body @ T_body_board(BOARD)
    points = sighting.board_mm @ T[:3, :3].T + T[:3, 3]
    camera_error = sighting.camera_px - rig.camera.project(points)
    projector_error = sighting.projector_px - rig.projector_pixel(points)
    assert len(points) > 40
    assert np.sqrt(np.mean(camera_error**2)) < 0.12
    assert np.sqrt(np.mean(projector_error**2)) < 0.12


def test_a_view_without_the_board_says_so(virtual: VirtualCapture) -> None:
    retina = FibreRetina(CoreMap.find(np.mean(virtual.whites()[:2], axis=0)))
    sides = [virtual.side("plane z=20", text) for text in (COLUMNS, ROWS)]
    seen = view("pose", retina, (sides[0][0](), sides[0][1]), (sides[1][0](), sides[1][1]), (960, 960))
    with pytest.raises(ValueError, match="no charuco"):
        sight(seen, BOARD, retina)
