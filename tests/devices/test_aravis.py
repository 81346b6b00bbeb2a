"""The Aravis driver over real GigE Vision packets on loopback: lost packets, a camera that goes, zero copy."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest
from fake_gige import FakeGige, running

from endo3d.services.devices.aravis_camera import AravisCamera, library
from endo3d.services.devices.camera import open_camera
from endo3d.services.devices.uri import DeviceError, Setting

WAIT_S = 60.0


@pytest.fixture(scope="module", autouse=True)
def installed() -> None:
    try:
        library()
    except DeviceError as error:
        pytest.skip(str(error))


@pytest.fixture
def lossy() -> Iterator[FakeGige]:
    """Every 200th packet is lost: with 46 packets per image about a fifth of the images."""
    with running(lost_ratio=0.005) as gige:
        yield gige


def opened(setting: Setting, options: str) -> AravisCamera:
    camera = open_camera(f"aravis:127.0.0.1?{options}", setting)
    assert isinstance(camera, AravisCamera)
    return camera


def test_lost_packets_never_give_a_torn_image(lossy: FakeGige, setting: Setting) -> None:
    """What comes is whole; what doesn't is a gap in the ids, counted, and its memory is used again."""
    camera = opened(setting, "trigger=none&fps=40&width=320&height=200")
    camera.set_exposure(1_000.0)
    camera.arm()
    lent = [np.zeros(camera.shape, camera.dtype) for _ in range(6)]
    for image in lent:
        camera.lend(image)
    ids: list[int] = []
    deadline = time.monotonic() + WAIT_S
    while camera.losses()["transport"] < 2 or len(ids) < 10:
        assert time.monotonic() < deadline, f"{len(ids)} images, {camera.losses()}"
        shot = camera.wait(0.1)
        if shot is None:
            continue
        ids.append(shot.frame_id)
        # The fake camera's ramp changes by a constant from pixel to pixel: a hole would break it.
        steps = np.diff(shot.image.astype(np.int16), axis=1) % 256
        assert np.unique(steps).size <= 2
        camera.lend(shot.image)
    losses = camera.losses()
    assert sorted(set(ids)) == ids
    assert losses["transport"] + losses["underrun"] == ids[-1] + 1 - len(ids)
    camera.close()


def wait_for_ever(camera: AravisCamera) -> None:
    deadline = time.monotonic() + WAIT_S
    while time.monotonic() < deadline:
        camera.wait(0.1)


@pytest.mark.slow
def test_a_camera_that_goes_is_said_to_be_gone(fake_gige: FakeGige, setting: Setting) -> None:
    camera = opened(setting, "trigger=Software&width=64&height=64")
    camera.arm()
    fake_gige.unplug()
    with pytest.raises(DeviceError, match="gone"):
        wait_for_ever(camera)
    camera.close()  # is quiet about it


def test_only_what_fits_is_taken(fake_gige: FakeGige, setting: Setting) -> None:
    camera = opened(setting, "trigger=Software&width=64&height=32&x=16&y=8")
    assert camera.shape == (32, 64)
    assert camera.corner == (16, 8)
    with pytest.raises(ValueError, match="lent"):
        camera.lend(np.zeros((32, 63), np.uint8))
    with pytest.raises(ValueError, match="lent"):
        camera.lend(np.zeros((32, 128), np.uint8)[:, ::2])
    camera.close()


def test_a_missing_camera_is_named(setting: Setting) -> None:
    with pytest.raises(DeviceError, match=r"can't be opened \(nobody\)"):
        open_camera("aravis:nobody", setting)


@pytest.mark.parametrize("options", ["format=RGB8", "exposure=long", "colour=1"])
def test_wrong_options_are_named(setting: Setting, options: str) -> None:
    with pytest.raises(DeviceError, match=options.partition("=")[0]):
        open_camera(f"aravis:?{options}", setting)
