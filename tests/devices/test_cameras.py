"""What every camera must do, over every driver that runs here: the same tests for simulated and real ones."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
from fake_gige import FakeGige

from endo3d.services.devices.bench import Bench
from endo3d.services.devices.camera import Camera, Shot, open_camera
from endo3d.services.devices.projector import open_projector
from endo3d.services.devices.uri import DeviceError, Setting
from endo3d_core import patterns

SET = patterns.parse("interleaved f1=15")
PERIOD_US = 25_000
WAIT_S = 60.0


@dataclass
class Rigged:
    """A camera, and how to make it expose."""

    camera: Camera
    trigger: Callable[[], None]
    makes: Literal["one", "all", "free"]
    """What a trigger makes: one image, or all from then on; a free-running camera needs none."""


def lit(bench: Path, setting: Setting) -> None:
    """Light on the bench for good."""
    projector = open_projector(f"sim:?bench={bench}", setting)
    projector.load([SET])
    projector.start(SET, PERIOD_US - 105, 105)


def images(folder: Path) -> list[np.ndarray]:
    folder.mkdir()
    made = [np.full((60, 96), 20 * k + 5, np.uint8) for k in range(8)]
    for k, image in enumerate(made):
        cv2.imwrite(str(folder / f"{k:03d}.png"), image)
    return made


def video(path: Path, frames: int) -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (96, 64))
    for k in range(frames):
        writer.write(np.full((64, 96, 3), 10 + 4 * k, np.uint8))
    writer.release()


@pytest.fixture(params=["sim", "folder", "uvc", "aravis"])
def rigged(request: pytest.FixtureRequest, tmp_path: Path, setting: Setting) -> Iterator[Rigged]:
    bench = tmp_path / "bench"
    match request.param:
        case "sim":
            made = Rigged(open_camera(f"sim:plane?bin=8&bench={bench}", setting), lambda: lit(bench, setting), "all")
        case "folder":
            images(tmp_path / "images")
            uri = f"folder:{tmp_path / 'images'}?bench={bench}"
            made = Rigged(open_camera(uri, setting), lambda: lit(bench, setting), "all")
        case "uvc":
            video(tmp_path / "film.avi", 30)
            made = Rigged(open_camera(f"uvc:{tmp_path / 'film.avi'}", setting), lambda: None, "free")
        case "aravis":
            gige = request.getfixturevalue("fake_gige")
            assert isinstance(gige, FakeGige)
            camera = open_camera(f"aravis:{gige.address}?trigger=Software&width=128&height=96", setting)
            made = Rigged(camera, camera.software_trigger, "one")  # type: ignore[attr-defined]
    yield made
    made.camera.close()


def take(rigged: Rigged, count: int) -> list[Shot]:
    """The next images, triggered as often as it needs."""
    if rigged.makes == "all":
        rigged.trigger()
    shots: list[Shot] = []
    deadline = time.monotonic() + WAIT_S
    while len(shots) < count:
        assert time.monotonic() < deadline, f"{len(shots)} of {count} images in time"
        if rigged.makes == "one":
            rigged.trigger()
        for _ in range(5):
            if (shot := rigged.camera.wait(0.02)) is not None:
                shots.append(shot)
                break
    return shots


def lend(camera: Camera, count: int) -> list[np.ndarray]:
    lent = [np.zeros(camera.shape, camera.dtype) for _ in range(count)]
    for image in lent:
        camera.lend(image)
    return lent


class TestEveryCamera:
    def test_it_fills_what_it_was_lent_in_that_order(self, rigged: Rigged) -> None:
        rigged.camera.arm()
        lent = lend(rigged.camera, 4)
        shots = take(rigged, 4)
        assert [shot.image is image for shot, image in zip(shots, lent, strict=True)] == [True] * 4
        assert all(image.any() for image in lent)

    def test_ids_and_stamps_rise_from_shot_to_shot(self, rigged: Rigged) -> None:
        began_ns = rigged.camera.now_ns()
        rigged.camera.set_exposure(5_000.0)
        rigged.camera.arm()
        lend(rigged.camera, 5)
        shots = take(rigged, 5)
        ids = [shot.frame_id for shot in shots]
        assert ids == sorted(set(ids))
        stamps = [shot.trigger_ns for shot in shots]
        assert stamps == sorted(set(stamps))
        assert began_ns - 100_000_000 < stamps[0] < stamps[-1] < rigged.camera.now_ns() + 100_000_000
        assert all(shot.exposure_us > 0 for shot in shots)

    def test_nothing_comes_without_a_trigger(self, rigged: Rigged) -> None:
        if rigged.makes == "free":
            pytest.skip("runs freely")
        rigged.camera.arm()
        lend(rigged.camera, 1)
        began = time.monotonic()
        assert rigged.camera.wait(0.05) is None
        assert time.monotonic() - began < WAIT_S

    def test_an_array_is_filled_again_after_it_was_lent_again(self, rigged: Rigged) -> None:
        rigged.camera.arm()
        (image,) = lend(rigged.camera, 1)
        (first,) = take(rigged, 1)
        image[:] = 0
        rigged.camera.lend(image)
        (second,) = take(rigged, 1)
        assert first.image is second.image is image
        assert image.any()
        assert second.frame_id > first.frame_id

    def test_what_finds_no_array_is_counted(self, rigged: Rigged) -> None:
        rigged.camera.arm()
        deadline = time.monotonic() + WAIT_S
        rigged.trigger()
        while rigged.camera.losses()["underrun"] == 0:
            assert time.monotonic() < deadline
            if rigged.makes == "one":
                rigged.trigger()
            assert rigged.camera.wait(0.05) is None

    def test_a_closed_camera_writes_no_more(self, rigged: Rigged) -> None:
        rigged.camera.arm()
        lent = lend(rigged.camera, 3)
        take(rigged, 1)
        rigged.camera.close()
        kept = [image.copy() for image in lent]
        time.sleep(0.1)  # nothing to wait for: what must not come is awaited
        for image, copy in zip(lent, kept, strict=True):
            np.testing.assert_array_equal(image, copy)

    def test_it_knows_its_format(self, rigged: Rigged) -> None:
        height, width = rigged.camera.shape
        assert height > 0
        assert width > 0
        assert np.dtype(rigged.camera.dtype) in (np.uint8, np.uint16)
        assert all(corner >= 0 for corner in rigged.camera.corner)


class TestFolder:
    def test_the_kth_pattern_shows_the_kth_image(self, tmp_path: Path, setting: Setting) -> None:
        made, bench = images(tmp_path / "images"), tmp_path / "bench"
        camera = open_camera(f"folder:{tmp_path / 'images'}?bench={bench}", setting)
        camera.arm()
        rigged = Rigged(camera, lambda: lit(bench, setting), "all")
        lend(camera, 12)
        shots = take(rigged, 12)
        light = Bench(bench)
        timeline = light.read().timeline
        assert timeline is not None
        for shot in shots:
            count, late_ns, _ = timeline.nearest(shot.trigger_ns)
            assert late_ns == 0
            np.testing.assert_array_equal(shot.image, made[count % len(made)])
        camera.close()
        light.close()

    @pytest.mark.parametrize("what", ["", "missing", "empty"])
    def test_no_images_are_named(self, tmp_path: Path, setting: Setting, what: str) -> None:
        (tmp_path / "empty").mkdir()
        with pytest.raises(DeviceError, match="folder:"):
            open_camera(f"folder:{tmp_path / what if what else ''}", setting)


class TestUvc:
    def test_the_end_of_the_film_is_a_camera_that_is_gone(self, tmp_path: Path, setting: Setting) -> None:
        video(tmp_path / "film.avi", 3)
        camera = open_camera(f"uvc:{tmp_path / 'film.avi'}", setting)
        camera.arm()
        lent = lend(camera, 4)
        for k in range(3):
            shot = camera.wait(1.0)
            assert shot is not None
            assert np.abs(lent[k].astype(int) - (10 + 4 * k)).max() <= 3  # JPEG
        with pytest.raises(DeviceError, match="no more images"):
            camera.wait(1.0)
        camera.close()

    def test_none_there(self, tmp_path: Path, setting: Setting, capfd: pytest.CaptureFixture[str]) -> None:
        with pytest.raises(DeviceError, match="no video"):
            open_camera(f"uvc:{tmp_path / 'none.avi'}", setting)


def test_a_log_is_the_players(setting: Setting) -> None:
    with pytest.raises(DeviceError, match=r"\[player\]"):
        open_camera("log:scan.mcap", setting)
