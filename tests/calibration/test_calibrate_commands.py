"""The command line: files in, files out, one clear line for every bad input."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from endo3d.schemas.messages import Frame
from endo3d.services.calibration.captured import captured
from endo3d.services.calibration.virtual import COLUMNS, ROWS
from endo3d.services.calibration.writing import writing
from endo3d.services.cli.calibrate import app
from endo3d.services.evaluation.virtual_run import START_NS, VirtualRun, head_yaml
from endo3d.services.runtime.errors import UserError
from endo3d_core import patterns
from endo3d_core.bow import POWERS
from endo3d_core.calibrating.boards import Board
from endo3d_core.calibration import Rig

HEAD = head_yaml("base6_wd20")
BOARD = Board.parse("checkerboard 5x4 pitch=1.0")
CALIBRATION = tuple(VirtualRun(HEAD, "plane", "still", COLUMNS, 132.0, 1).calibration())


def run(*words: str | Path) -> tuple[int, str]:
    """Exit code and what was said."""
    result = CliRunner().invoke(app, [str(word) for word in words])
    if isinstance(result.exception, UserError):
        return 2, str(result.exception)
    return result.exit_code, result.output


def frames(pattern_set: str, epoch: int) -> list[Frame]:
    """Small images that tell pose and slot apart."""
    return [
        Frame(
            START_NS + epoch * 10**9 + slot * 10**7, slot, np.full((24, 32), 16 * epoch + slot, np.uint8), pattern_set,
            slot, epoch, 7000.0, START_NS + epoch * 10**9 + slot * 10**7, slot,
        )
        for slot in range(len(patterns.parse(pattern_set)))
    ]  # fmt: skip


@pytest.mark.parametrize("name", ["poses", "poses.mcap"])
def test_what_was_written_is_read_again(tmp_path: Path, name: str) -> None:
    out = tmp_path / name
    with writing(out, BOARD, CALIBRATION, simulated=False) as into:  # type: ignore[arg-type]
        for epoch, pose in ((1, "board_00"), (3, "board_01"), (5, "flat_00")):
            into.pose(pose, frames(COLUMNS, epoch), frames(ROWS, epoch + 1))
    taken = captured(out)
    assert taken.board == BOARD
    assert taken.window == (960, 960)
    assert [pose.name for pose in taken.boards] == ["board_00", "board_01"]
    assert [pose.name for pose in taken.flats] == ["flat_00"]
    images, shown = taken.boards[1].rows
    assert [int(image[0, 0]) for image in images()] == [16 * 4 + slot for slot in range(len(shown))]
    assert all(p.axis == "rows" for p in shown)
    with pytest.raises(UserError, match="exists"):
        writing(out, BOARD, CALIBRATION, simulated=False)  # type: ignore[arg-type]


def test_a_capture_of_other_software_two_frequencies_in_three_steps(tmp_path: Path) -> None:
    lines = ['board = "circles 8x6 pitch=12"', "projector = [1920, 1080]", 'boards = "*_board"']
    for axis in ("columns", "rows"):
        for pitch_px in (66.67, 68.97):
            for shift in (-2.0944, 0.0, 2.0944):
                lines += ["[[pattern]]", f'axis = "{axis}"', f"pitch_px = {pitch_px}", f"shift = {shift}"]
    (tmp_path / "capture.toml").write_text("\n".join(lines), encoding="utf-8")
    (tmp_path / "1_board").mkdir()
    for number in range(12):
        cv2.imwrite(str(tmp_path / "1_board" / f"shot{number}.png"), np.full((20, 30), number, np.uint8))
    taken = captured(tmp_path)
    images, shown = taken.boards[0].columns
    assert [int(image[0, 0]) for image in images()] == list(range(6))
    assert shown[0].frequency == pytest.approx(1920 / 66.67)
    assert taken.boards[0].rows[1][3].frequency == pytest.approx(1080 / 68.97)


def test_bad_inputs_are_one_clear_line(tmp_path: Path) -> None:
    good = tmp_path / "good"
    with writing(good, BOARD, CALIBRATION, simulated=False) as into:  # type: ignore[arg-type]
        into.pose("board_00", frames(COLUMNS, 1), frames(ROWS, 2))
    out = tmp_path / "rig.yaml"
    (tmp_path / "empty").mkdir()
    description = (good / "capture.toml").read_text(encoding="utf-8")
    for words, why in (
        (("solve", tmp_path / "nothing", "-o", out), "neither a folder"),
        (("solve", tmp_path / "empty", "-o", out), "capture.toml"),
        (("solve", good, "-o", tmp_path / "rig.txt"), "ends in .yaml"),
        (("solve", good, "-o", out), "at least 3"),
        (("capture", "-o", tmp_path / "x", "--board", "chess 3x3"), "starts with one of"),
        (("capture", "-o", good, "--virtual", "base6_wd20"), "exists"),
        (("capture", "-o", tmp_path / "y", "--virtual", "no_head"), "base6_wd20"),
        (("export", tmp_path / "none.yaml", "--ros", tmp_path), "name a calibration file"),
        (("verify", good / "head.yaml", good), "no flat reference"),
    ):
        code, said = run(*words)
        assert code == 2, words
        assert why in said, (words, said)
        assert "\n" not in said.strip()
    for change, why in (
        (description.replace("checkerboard 5x4", "checkerboard 5"), "columns x rows"),
        (description.replace('axis = "rows"', 'axis = "columns"'), "both axes"),
        (description.replace("projector", "beamer"), "projector"),
        ("board = [", "not TOML"),
    ):
        (good / "capture.toml").write_text(change, encoding="utf-8")
        code, said = run("solve", good, "-o", out)
        assert code == 2
        assert why in said
    (good / "capture.toml").write_text(description, encoding="utf-8")
    (good / "board_00" / "07.png").unlink()
    code, said = run("solve", good, "-o", out)
    assert code == 2
    assert "image 7 is missing" in said
    assert not out.exists()


def test_exports_are_read_by_opencv_and_by_ros(tmp_path: Path) -> None:
    rig_file = tmp_path / "rig.yaml"
    bow = f"flat_reference:\n  inverse_depth: 0.05\n  coefficients: {[0.0] * len(POWERS)}\n"
    rig_file.write_text(Rig.from_yaml(HEAD).to_yaml() + bow, encoding="utf-8")
    code, said = run("export", rig_file, "--opencv", tmp_path / "cv.yaml", "--ros", tmp_path / "info")
    assert code == 0
    assert "no place in these files" in said
    rig = Rig.from_yaml(HEAD)
    storage = cv2.FileStorage(str(tmp_path / "cv.yaml"), cv2.FILE_STORAGE_READ)
    np.testing.assert_array_equal(storage.getNode("camera_matrix").mat(), rig.camera.K)
    np.testing.assert_array_equal(storage.getNode("projector_distortion").mat().ravel(), rig.projector.dist)
    np.testing.assert_array_equal(storage.getNode("R").mat(), rig.R)
    np.testing.assert_array_equal(storage.getNode("T").mat().ravel(), rig.t)
    storage.release()
    info = yaml.safe_load((tmp_path / "info" / "projector.yaml").read_text(encoding="utf-8"))
    assert info["distortion_model"] == "plumb_bob"
    assert info["image_width"] == 960
    np.testing.assert_array_equal(info["camera_matrix"]["data"], rig.projector.K.ravel())
    code, said = run("export", rig_file)
    assert code == 2
    assert "--opencv" in said
