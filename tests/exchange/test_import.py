"""Anyone's images: a folder with capture.toml becomes a log that decodes to the true surface."""

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from endo3d.schemas import topics
from endo3d.schemas.messages import Cloud, Frame
from endo3d.services.archive.reader import Log
from endo3d.services.cli.import_ import import_
from endo3d.services.importing.capture import Capture
from endo3d.services.importing.folder import images, numbered
from endo3d.services.runtime.errors import UserError
from endo3d_core import patterns
from endo3d_core.calibration import Lens, Rig

WIDTH, HEIGHT = 320, 240


def desktop_rig() -> Rig:
    """A bench scanner at 300 mm, nothing like the endoscope."""
    camera = Lens(WIDTH, HEIGHT, [[400, 0, 158], [0, 401, 121], [0, 0, 1]], [-0.1, 0.03, 3e-4, -2e-4, 0])
    projector = Lens(1024, 768, [[1400, 0, 520], [0, 1395, 390], [0, 0, 1]], [-0.05, 0.01, 0, 2e-4, 0])
    R = cv2.Rodrigues(np.array([0.01, 0.33, -0.005]))[0]
    return Rig(camera, projector, R, np.array([-98.0, 1.5, 14.0]))


def plane_mm(rig: Rig) -> np.ndarray:
    """(height, width, 3) points of a tilted plane behind every pixel."""
    ray = rig.camera.ray(rig.camera.pixel_grid())
    normal, distance = np.array([0.25, -0.1, 1.0]), 300.0
    return ray * (distance / (ray @ normal))[..., None]


def write_shots(folder: Path, rig: Rig, shown: list[patterns.Pattern], bits: int = 8, first: int = 0) -> None:
    folder.mkdir(exist_ok=True)
    (folder / "rig.yaml").write_text(rig.to_yaml())
    lit = rig.projector_pixel(plane_mm(rig))
    for number, pattern in enumerate(shown, first):
        axis = 0 if pattern.axis == "columns" else 1
        light = patterns.profile(pattern, lit[..., axis], (rig.projector.width, rig.projector.height)[axis])
        grey = np.rint((0.05 + 0.8 * light) * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)
        assert cv2.imwrite(str(folder / f"shot{number:03d}.{'png' if bits == 8 else 'tif'}"), grey)


def toml(shown: list[patterns.Pattern], head: str = "", *, pitch_of: int = 0) -> str:
    lines = ['calibration = "rig.yaml"', "z_mm = [220, 420]", head]
    for p in shown:
        width = f"pitch_px = {pitch_of / p.frequency!r}" if pitch_of else f"f = {p.frequency!r}"
        lines += ["[[pattern]]", width, f"shift = {p.shift_rad!r}", f'axis = "{p.axis}"']
    return "\n".join(lines)


def endo3d(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "endo3d.services.cli.app", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)


THREE_STEP = list(patterns.parse("sequence f=30/30/30/29/29/29 shifts=-2.0944/0/2.0944/-2.0944/0/2.0944").patterns)


def clouds_of(log: Path) -> list[Cloud]:
    return [m for m in Log(log).messages(topics.CLOUD) if isinstance(m, Cloud)]


@pytest.mark.parametrize(("bits", "pitch_of"), [(8, 0), (16, 1024)])
def test_two_frequencies_in_three_steps_decode_to_the_plane(tmp_path: Path, bits: int, pitch_of: int) -> None:
    rig = desktop_rig()
    folder = tmp_path / "shots"
    write_shots(folder, rig, THREE_STEP, bits)
    (folder / "capture.toml").write_text(toml(THREE_STEP, pitch_of=pitch_of))
    imported = endo3d("import", folder, "-o", tmp_path / "shots.mcap")
    assert imported.returncode == 0, imported.stderr
    replayed = endo3d("replay", tmp_path / "shots.mcap", "--out", tmp_path / "out.mcap")
    assert replayed.returncode == 0, replayed.stderr
    files = [tmp_path / name for name in ("cloud.ply", "depth.npy", "phase.npy")]
    wanted = [
        part for option, file in zip(("--cloud", "--depth", "--phase"), files, strict=True) for part in (option, file)
    ]
    exported = endo3d("export", tmp_path / "out.mcap", *wanted)
    assert exported.returncode == 0, exported.stderr
    (cloud,) = clouds_of(tmp_path / "out.mcap")
    assert cloud.points.shape == (HEIGHT, WIDTH)
    truth = plane_mm(rig)
    found = cloud.channels[..., :3]
    valid = np.isfinite(found[..., 2])
    lit = rig.projector_pixel(truth)
    inside = np.all((lit > 2) & (lit < np.array([1021, 765])), axis=-1)
    assert valid[inside].mean() > 0.99
    error_mm = np.linalg.norm(found - truth, axis=-1)[valid & inside]
    # 8 bit: rounding, 0.29 grey of 102 grey modulation. 16 bit: the lookup's cubic over this wide depth range.
    assert np.sqrt(np.mean(error_mm**2)) < (0.02 if bits == 8 else 0.01)
    assert len(trimesh.load(files[0]).vertices) == valid.sum()
    depth_mm, phase = np.load(files[1]), np.load(files[2])
    np.testing.assert_allclose(depth_mm[valid], found[..., 2][valid], atol=0.002)  # 16 bit over 200 mm
    true_phase = 2 * np.pi * 30 * lit[..., 0] / rig.projector.width
    rms_rad = np.sqrt(np.mean((phase - true_phase)[valid & inside] ** 2))
    assert rms_rad < (0.006 if bits == 8 else 0.002)  # 8 bit: 0.29 / 102 * sqrt(2 / 3) and the other frequency


def test_both_axes_are_epochs_of_their_own(tmp_path: Path) -> None:
    shown = [*THREE_STEP, *(patterns.Pattern(p.frequency, p.shift_rad, "rows") for p in THREE_STEP)]
    write_shots(tmp_path / "both", desktop_rig(), shown * 2, first=7)
    (tmp_path / "both" / "capture.toml").write_text(toml(shown, "repeat = 2"))
    assert endo3d("import", tmp_path / "both", "-o", tmp_path / "both.mcap").returncode == 0
    frames = [m for m in Log(tmp_path / "both.mcap").messages(topics.FRAME) if isinstance(m, Frame)]
    assert [f.epoch for f in frames] == [1] * 6 + [2] * 6 + [3] * 6 + [4] * 6
    assert [f.slot for f in frames] == [*range(6)] * 4
    assert [f.sequence for f in frames] == list(range(24))
    assert "axis=rows" in frames[7].pattern_set
    assert "axis=rows" not in frames[3].pattern_set


def test_the_continuous_sequence_is_recognised(tmp_path: Path) -> None:
    shown = list(patterns.interleaved(25).patterns)
    write_shots(tmp_path, desktop_rig(), [])
    path = tmp_path / "capture.toml"
    path.write_text(toml(shown))
    assert [s.text for s in Capture.read(path).sets] == ["interleaved f1=25"]
    path.write_text(toml(shown[::-1]))
    assert Capture.read(path).sets[0].kind == "sequence"


def test_the_depth_range_is_about_where_the_axes_meet(tmp_path: Path) -> None:
    write_shots(tmp_path, desktop_rig(), [])
    path = tmp_path / "capture.toml"
    path.write_text(toml(THREE_STEP).replace("z_mm = [220, 420]", ""))
    near, far = Capture.read(path).z_mm
    assert near < 220
    assert far > 420


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("rate_hz = 30", "rate_hz = fast"), "is not TOML"),
        (("rate_hz = 30", "rate = 30"), "no key 'rate'; the nearest is 'rate_hz'"),
        (("shift = 0.0", "schift = 0.0"), "'pattern.1.schift'; the nearest is 'shift'"),
        (('calibration = "rig.yaml"', ""), "'calibration' is missing"),
        (("rig.yaml", "other.yaml"), "other.yaml: No such file"),
        (("f = 30.0", "f = 30.0\npitch_px = 20"), "either f (periods) or pitch_px"),
        (("rate_hz = 30", "repeat = 2"), "holds 6 images, capture.toml describes 12"),
        (("z_mm = [220, 420]", "z_mm = [420, 220]"), "no depth range"),
        (("rate_hz = 30", 'images = "*.bmp"'), "holds no image '*.bmp'"),
    ],
)
def test_a_wrong_description_is_one_line(tmp_path: Path, change: tuple[str, str], says: str) -> None:
    shown = [patterns.Pattern(float(p.frequency), p.shift_rad) for p in THREE_STEP]
    write_shots(tmp_path, desktop_rig(), shown)
    text = toml(shown, "rate_hz = 30")
    assert change[0] in text
    (tmp_path / "capture.toml").write_text(text.replace(*change))
    with pytest.raises(UserError) as refused:
        import_(tmp_path, tmp_path / "x.mcap")
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)
    assert not list(tmp_path.glob("*.mcap"))


def test_a_refused_folder_ends_with_code_2_and_no_traceback(tmp_path: Path) -> None:
    result = endo3d("import", tmp_path, "-o", tmp_path / "x.mcap")
    assert result.returncode == 2
    assert "capture.toml" in result.stderr
    assert "Traceback" not in result.stderr


def test_a_missing_image_is_named(tmp_path: Path) -> None:
    write_shots(tmp_path, desktop_rig(), THREE_STEP)
    (tmp_path / "shot003.png").unlink()
    with pytest.raises(UserError, match="image 3 is missing"):
        numbered(tmp_path)


def test_images_must_be_alike_and_fit_the_calibration(tmp_path: Path) -> None:
    write_shots(tmp_path, desktop_rig(), THREE_STEP)
    paths = numbered(tmp_path)
    with pytest.raises(UserError, match="the calibration's camera 640x480"):
        list(images(paths, (480, 640)))
    cv2.imwrite(str(paths[4]), np.zeros((10, 10), np.uint8))
    with pytest.raises(UserError, match=r"shot004\.png is 10x10 of 8 bit, shot000\.png is 320x240"):
        list(images(paths, (HEIGHT, WIDTH)))
    paths[4].write_bytes(b"no image")
    with pytest.raises(UserError, match=r"shot004\.png can't be read"):
        list(images(paths, (HEIGHT, WIDTH)))
