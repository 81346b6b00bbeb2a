"""Pictures, figures and recordings of a scan: made without a screen, and not of nothing."""

from __future__ import annotations

import ctypes.util
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rerun.blueprint as rrb
from hypothesis import given
from hypothesis import strategies as st
from rerun.chunk import RrdReader
from scans import map_of, messages, points_of, write_log

from endo3d.schemas import messages as m
from endo3d.services.archive.reader import Log
from endo3d.services.runtime.errors import UserError
from endo3d.services.views import entries
from endo3d.services.views.blueprint import scan_blueprint
from endo3d.services.views.colour import TABLES, coloured, packed
from endo3d.services.views.colouring import by_deviation, by_quality
from endo3d.services.views.figures import figure, scale_bar_mm
from endo3d.services.views.headless import rerun_picture
from endo3d.services.views.picture import picture
from endo3d.services.views.recording import write_rrd
from endo3d.services.views.scan import Scan


def image_of(path: Path) -> np.ndarray:
    image = cv2.imread(str(path))
    assert image is not None
    return image


@pytest.mark.parametrize("colour", ["height", "quality", "deviation"])
def test_a_scan_makes_a_picture(tmp_path: Path, colour: str) -> None:
    scan = Scan.of(messages())
    deviation_um = np.linspace(-20, 20, len(scan.points()))
    picture(scan, tmp_path / "scan.png", colour=colour, deviation_um=deviation_um)
    image = image_of(tmp_path / "scan.png")
    assert image.shape == (1350, 2400, 3)
    cloud = image[300:1150, 200:1500].astype(float)
    assert cloud.std() > 10  # a cloud in colours, not the even background


def test_a_log_without_a_map_shows_its_last_cloud(tmp_path: Path) -> None:
    scan = Scan.of(message for message in messages() if isinstance(message, m.Cloud))
    assert len(scan.points()) == np.isfinite(points_of(5)["z"]).sum()
    picture(scan, tmp_path / "cloud.png")


def test_an_empty_log_makes_an_empty_picture(tmp_path: Path) -> None:
    picture(Scan.of([]), tmp_path / "empty.png")
    assert image_of(tmp_path / "empty.png").shape == (1350, 2400, 3)


def test_deviation_needs_a_value_per_point(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="one deviation_um per point"):
        picture(Scan.of(messages()), tmp_path / "x.png", colour="deviation")


def test_a_scan_keeps_nothing_of_the_memory_it_was_shown() -> None:
    scan = Scan()
    for message in messages(2):
        if isinstance(message, m.Frame):
            image = message.image.copy()
            scan.add(replace(message, image=image))
            image[:] = 0
    assert scan.frame is not None
    assert scan.frame.image.any()


def test_a_log_is_summed_up_without_reading_every_image(tmp_path: Path) -> None:
    write_log(tmp_path / "scan.mcap", frames=40)
    log = Log(tmp_path / "scan.mcap")
    quick, whole = Scan.of_log(log), Scan.of(log.messages())
    assert (quick.frames, quick.seconds) == (whole.frames, whole.seconds) == (40, pytest.approx(39 / 25))
    np.testing.assert_array_equal(quick.points(), whole.points())
    np.testing.assert_array_equal(quick.track(), whole.track())
    assert quick.working_distance_mm == whole.working_distance_mm
    assert quick.frame is not None
    assert quick.frame.sequence >= 31
    assert quick.depth is not None


def test_colours_run_from_low_to_high_and_nan_is_grey() -> None:
    rgb = coloured(np.array([-1.0, 0.0, 1.0, 2.0, np.nan]), 0.0, 1.0, "height")
    np.testing.assert_array_equal(rgb[:4], TABLES["height"][[0, 0, 255, 255]])
    assert np.ptp(rgb[4]) < 10


def test_lightness_grows_with_height_and_deviation_is_white_at_zero() -> None:
    lightness = cv2.cvtColor(TABLES["height"][None], cv2.COLOR_RGB2LAB)[0, :, 0].astype(int)
    assert (np.diff(lightness) >= -1).all()
    assert TABLES["deviation"][[127, 128]].min() > 235
    shown = by_deviation(np.array([-30.0, 0.0, 10.0] * 50))
    assert shown.low == -shown.high


def test_quality_of_a_map_is_the_sigma_of_its_means() -> None:
    rows = map_of(points_of(0))
    rows["count"][: len(rows) // 2] = 16
    shown = by_quality(rows)
    np.testing.assert_allclose(shown.values[[0, -1]], [1.25, 2.5], rtol=1e-6)
    rgb = shown.rgb()
    assert rgb[0, 1] > rgb[-1, 1]  # the better half is greener


@given(st.lists(st.tuples(*[st.integers(0, 255)] * 3), min_size=1, max_size=5))
def test_packed_colours_are_red_first(colours: list[tuple[int, int, int]]) -> None:
    words = packed(np.array(colours, np.uint8))
    expected = [(r << 24) | (g << 16) | (b << 8) | 255 for r, g, b in colours]
    assert words.tolist() == expected


@given(st.floats(1e-3, 1e4))
def test_a_scale_bar_is_round_and_fits(width_mm: float) -> None:
    length = scale_bar_mm(width_mm)
    assert 0.05 * width_mm < length <= width_mm / 5
    digits = f"{length:e}".split("e")[0].rstrip("0.")
    assert digits in ("1", "2", "5")


def test_a_figure_says_that_it_is_simulated(tmp_path: Path) -> None:
    for simulated in (True, False):
        with figure("Sigma", simulated=simulated, path=tmp_path / "a.svg") as fig:
            fig.subplots().plot([0, 1], [1, 2])
        words = [text.get_text() for text in fig.texts]
        assert ("simulated" in words) is simulated
        assert (tmp_path / "a.svg").stat().st_size > 1000


def test_a_recording_holds_the_layout_and_the_whole_map(tmp_path: Path) -> None:
    write_rrd(messages(), tmp_path / "scan.rrd")
    reader = RrdReader(tmp_path / "scan.rrd")
    assert reader.blueprints()
    chunks = reader.stream(store=reader.recordings()[0]).to_chunks()
    maps = [chunk.to_record_batch() for chunk in chunks if chunk.entity_path == "/" + entries.MAP]
    positions = [row for batch in maps for row in batch.column("Points3D:positions").to_pylist()]
    assert len(positions[-1]) == len(Scan.of(messages()).points())


def test_the_layout_has_all_that_a_scan_is_watched_by() -> None:
    def origins(part: object) -> list[str]:
        inside = getattr(part, "contents", [])
        below = inside if isinstance(inside, (list, tuple)) else []
        own = [str(part.origin)] if isinstance(part, rrb.View) else []
        return own + [origin for child in below for origin in origins(child)]

    plots = [f"/{entries.PLOTS}/{name}" for name in ("pose", "rate_hz", "latency_p50_ms")]
    expected = {f"/{name}" for name in (entries.WORLD, entries.CAMERA, entries.IMAGE, entries.DEPTH, entries.LOG)}
    assert set(origins(scan_blueprint().root_container)) == expected | set(plots)


@pytest.mark.slow
@pytest.mark.skipif(ctypes.util.find_library("vulkan") is None, reason="no Vulkan: see docs/viewing.md")
def test_rerun_draws_it_without_a_screen(tmp_path: Path) -> None:
    write_rrd(messages(), tmp_path / "scan.rrd")
    rerun_picture(tmp_path / "scan.rrd", tmp_path / "scan.png", size=(800, 500))
    image = image_of(tmp_path / "scan.png")
    assert image.shape == (500, 800, 3)
    assert image.std() > 10


@pytest.mark.slow
@pytest.mark.skipif(ctypes.util.find_library("vulkan") is None, reason="no Vulkan: see docs/viewing.md")
def test_a_picture_of_no_recording_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "torn.rrd").write_bytes(b"nothing")
    with pytest.raises(UserError, match="can't"):
        rerun_picture(tmp_path / "torn.rrd", tmp_path / "scan.png")
