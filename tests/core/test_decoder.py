"""The decoder service: messages in, messages out, windows that never mix what does not belong together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from planes import HEADS, Plane, field, render, small_rig

from endo3d.schemas.messages import CameraCalibration, Cloud, DepthMap, Frame, ProjectorCalibration
from endo3d.services.decoder import Decoder, DecoderConfig
from endo3d.services.runtime.errors import UserError
from endo3d_core import patterns, triangulation
from endo3d_core.fibre import NO_CROSSTALK, CoreMap

INTERLEAVED = "interleaved f1=25"
PERIOD_NS = 7_576_000


@pytest.fixture(scope="module")
def images() -> dict[str, list[np.ndarray]]:
    rng = np.random.default_rng(4)
    return {
        text: [render(small_rig(), p, Plane(), rng=rng) for p in patterns.parse(text).patterns]
        for text in (INTERLEAVED, "conventional f=50/49/43 steps=4/2/2")
    }


def frame(images: dict[str, list[np.ndarray]], k: int, text: str = INTERLEAVED, epoch: int = 1) -> Frame:
    period = images[text]
    return Frame(
        stamp_ns=10**18 + k * PERIOD_NS,
        sequence=k,
        image=period[k % len(period)],
        pattern_set=text,
        slot=k % len(period),
        epoch=epoch,
        exposure_us=7000.0,
        trigger_ns=10**18 + k * PERIOD_NS - 3_500_000,
        camera_frame_id=k,
    )


def decoder(**config: object) -> Decoder:
    made = Decoder(DecoderConfig(head=str(HEADS / "base6_wd20.yaml"), **config))
    made.open()
    return made


def test_one_cloud_and_one_depth_map_per_frame_once_the_window_is_full(images) -> None:  # type: ignore[no-untyped-def]
    service = decoder()
    out = [list(service.step(frame(images, k))) for k in range(12)]
    assert [len(o) for o in out] == [0] * 6 + [2] * 6
    cloud, depth = out[6]
    assert isinstance(cloud, Cloud)
    assert isinstance(depth, DepthMap)
    assert (cloud.sequence, cloud.stamp_ns) == (3, 10**18 + 3 * PERIOD_NS)
    assert cloud.newest_stamp_ns == 10**18 + 6 * PERIOD_NS
    assert (cloud.window_frames, cloud.grid_px, cloud.points.shape) == (7, 2.0, (300, 480))
    assert cloud.valid_count == np.isfinite(cloud.points["z"]).sum()
    truth = Plane().depth(small_rig().camera.ray(triangulation.grid_pixels(small_rig(), 2, "columns")))
    inside = field(small_rig(), 2)
    assert np.nanstd((cloud.points["z"] - truth)[inside]) < 3e-3
    z = np.where(depth.depth > 0, depth.offset_mm + depth.scale_mm * depth.depth, np.nan)
    np.testing.assert_allclose(z, cloud.points["z"], atol=0.51 * depth.scale_mm + 2e-6)


def test_a_lost_frame_empties_the_window(images) -> None:  # type: ignore[no-untyped-def]
    service = decoder()
    ready = [bool(list(service.step(frame(images, k)))) for k in range(20) if k != 9]
    assert ready == [False] * 6 + [True] * 3 + [False] * 6 + [True] * 4
    assert service.values()["windows_dropped"] == 1


def test_frames_of_two_epochs_never_decode_together(images) -> None:  # type: ignore[no-untyped-def]
    service = decoder()
    ready = [bool(list(service.step(frame(images, k, epoch=1 + (k >= 8))))) for k in range(16)]
    assert ready == [False] * 6 + [True] * 2 + [False] * 6 + [True] * 2


def test_a_mode_switch_and_back(images) -> None:  # type: ignore[no-untyped-def]
    service, conventional = decoder(), "conventional f=50/49/43 steps=4/2/2"
    for k in range(7):
        list(service.step(frame(images, k)))
    clouds = [list(service.step(frame(images, k, conventional, epoch=2))) for k in range(8, 24)]
    assert [len(o) for o in clouds] == ([0] * 7 + [2]) * 2
    cloud = clouds[7][0]
    assert isinstance(cloud, Cloud)
    assert (cloud.window_frames, cloud.pattern_set) == (8, conventional)
    assert [len(list(service.step(frame(images, k, epoch=3)))) for k in range(24, 32)] == [0] * 6 + [2] * 2


def test_calibration_may_come_as_messages(images) -> None:  # type: ignore[no-untyped-def]
    service = Decoder(DecoderConfig())
    service.open()
    assert not list(service.step(frame(images, 0)))
    rig, text = small_rig(), (HEADS / "base6_wd20.yaml").read_text()
    camera = CameraCalibration(1, rig.camera.width, rig.camera.height, rig.camera.K, rig.camera.dist)
    p = rig.projector
    projector = ProjectorCalibration(1, p.width, p.height, p.K, p.dist, rig.T_projector_camera, text)
    for message in (camera, projector):
        assert not list(service.step(message))
    ready = []
    for k in range(1, 10):
        ready.append(bool(list(service.step(frame(images, k)))))
        list(service.step(replace(camera, stamp_ns=k)))  # repeated, as latched topics are: changes nothing
    assert ready == [False] * 6 + [True] * 3


def test_frames_of_another_format_say_so(images) -> None:  # type: ignore[no-untyped-def]
    wrong = replace(frame(images, 0), image=np.zeros((480, 640), np.uint8))
    with pytest.raises(UserError, match="640x480"):
        list(decoder().step(wrong))


def test_a_head_that_is_not_there_says_so() -> None:
    with pytest.raises(UserError, match="nowhere"):
        Decoder(DecoderConfig(head="/nowhere.yaml")).open()


def test_a_replay_is_bit_exact(images) -> None:  # type: ignore[no-untyped-def]
    first, second = (
        [m for k in range(9) for m in service.step(frame(images, k))] for service in (decoder(), decoder())
    )
    for a, b in zip(first, second, strict=True):
        if isinstance(a, Cloud):
            assert isinstance(b, Cloud)
            np.testing.assert_array_equal(a.channels, b.channels)


def honeycomb(pitch_px: float = 4.0) -> CoreMap:
    """Cores that the small rig's camera could see: their flat image and where they are."""
    camera = small_rig().camera
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    middle = ((camera.width - 1) / 2, (camera.height - 1) / 2)
    i, j = np.meshgrid(np.arange(-90, 91), np.arange(-90, 91))
    at = np.stack((i + 0.5 * (j % 2), np.sqrt(0.75) * j), axis=-1).reshape(-1, 2) * pitch_px
    cores = at[np.hypot(*at.T) < 0.3 * camera.width] + middle
    flat = np.zeros(u.shape)
    for k in ((0.0, 2.0), (np.sqrt(3.0), 1.0), (np.sqrt(3.0), -1.0)):  # three waves at 60 degrees
        wave = 2 * np.pi / (np.sqrt(3.0) * pitch_px) * np.array(k)
        flat += np.cos(wave[0] * (u - middle[0]) + wave[1] * (v - middle[1]))
    flat = 60.0 * (1.6 + flat) * (np.hypot(u - middle[0], v - middle[1]) < 0.305 * camera.width)
    return CoreMap(flat.astype(np.float32), cores, pitch_px, NO_CROSSTALK)


def test_a_core_map_takes_the_place_of_binning(tmp_path, images) -> None:  # type: ignore[no-untyped-def]
    cores = honeycomb()
    path = tmp_path / "head.fibre.npz"
    path.write_bytes(cores.to_npz())
    service = decoder(fibre=str(path))
    share = cores.flat / cores.flat.max()
    seen = {INTERLEAVED: [np.rint(share * image).astype(np.uint8) for image in images[INTERLEAVED]]}
    cloud = next(m for k in range(7) for m in service.step(frame(seen, k)))
    assert isinstance(cloud, Cloud)
    truth = Plane().depth(small_rig().camera.ray(triangulation.grid_pixels(small_rig(), 2, "columns")))
    inner = np.s_[100:200, 190:290]
    assert np.isfinite(cloud.points["z"][inner]).mean() > 0.99
    assert np.nanstd((cloud.points["z"] - truth)[inner]) < 8e-3


def test_a_head_names_its_core_map(tmp_path) -> None:  # type: ignore[no-untyped-def]
    text = (HEADS / "base6_wd20.yaml").read_text()
    head = tmp_path / "head.yaml"
    head.write_text(text.replace("    cores: 100000", "    cores: 100000\n    core_map: head.fibre.npz"))
    service = Decoder(DecoderConfig(head=str(head)))
    service.open()
    with pytest.raises(UserError, match=r"head\.fibre\.npz"):
        service.warm()
    (tmp_path / "head.fibre.npz").write_bytes(b"not it")
    with pytest.raises(UserError, match="no map of fibre cores"):
        service.warm()


def test_warming_compiles_without_frames() -> None:
    decoder().warm()
