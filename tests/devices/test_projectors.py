"""What every projector must do, over every driver that runs here: the same tests for simulated and real ones."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from endo3d.services.devices.bench import Bench, Shown
from endo3d.services.devices.projector import Projector, open_projector
from endo3d.services.devices.uri import DeviceError, Setting
from endo3d_core import patterns
from endo3d_core.calibration import Rig

INTERLEAVED = patterns.parse("interleaved f1=25")
CONVENTIONAL = patterns.parse("conventional f=50/49/43 steps=4/2/2")
HDR = patterns.parse("conventional f=50/49/43 steps=4/2/2 exposures_us=10200/40800/163200")
ROWS = patterns.parse("interleaved f1=15 axis=rows gamma=2.2")
BINARY = patterns.parse("conventional f=16/15 steps=4/2 wave=binary")
SETS = (INTERLEAVED, CONVENTIONAL, HDR, ROWS, BINARY)


@pytest.fixture(params=["sim:?", "dlpc900:emulated?", "dlpc900:emulated?dmd=9000&", "dlpc900:emulated?x=-40&y=21&"])
def uri(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return f"{request.param}bench={tmp_path / 'bench'}"


@pytest.fixture
def projector(uri: str, setting: Setting) -> Iterator[Projector]:
    opened = open_projector(uri, setting)
    yield opened
    opened.close()


@pytest.fixture
def bench(tmp_path: Path, projector: Projector) -> Iterator[Bench]:
    opened = Bench(tmp_path / "bench")
    yield opened
    opened.close()


def images(bench: Bench) -> list[np.ndarray]:
    shown = bench.read()
    return [bench.image(place, shown) for place in shown.images]


class TestEveryProjector:
    def test_pictures_come_out_bit_exact(self, projector: Projector, bench: Bench, setting: Setting) -> None:
        window = Rig.from_yaml(setting.head_yaml).projector
        projector.load(SETS)
        for pattern_set in SETS:
            projector.start(pattern_set, 7471.0, 105.0)
            shown = images(bench)
            assert len(shown) == len(pattern_set)
            for image, pattern in zip(shown, pattern_set.patterns, strict=True):
                np.testing.assert_array_equal(image, patterns.image(pattern, window.width, window.height))

    def test_times_are_those_wanted(self, projector: Projector, bench: Bench) -> None:
        projector.load([HDR, INTERLEAVED])
        projector.start(HDR, 7471.0, 105.0)
        own = [pattern.exposure_us for pattern in HDR.patterns]
        assert bench.read().exposures_us == pytest.approx(own, abs=0.5)
        projector.start(INTERLEAVED, 7471.0, 234.0)
        assert bench.read().exposures_us == pytest.approx([7471.0] * 4, abs=0.5)
        assert bench.read().dark_us == 234.0

    def test_a_switch_moves_no_picture(self, projector: Projector, bench: Bench) -> None:
        sets = (INTERLEAVED, CONVENTIONAL)
        projector.load(sets)
        for pattern_set in sets:
            projector.start(pattern_set, 7471.0, 105.0)
        generation = bench.read().generation
        for pattern_set in sets:
            projector.start(pattern_set, 9000.0, 105.0)
        assert bench.read().generation == generation

    def test_start_says_when_slot_0_begins(self, projector: Projector, bench: Bench) -> None:
        projector.load([INTERLEAVED])
        projector.start(INTERLEAVED, 7471.0, 105.0)  # first light: the emulator's bench takes the pictures
        before_ns = time.time_ns()
        start_ns = projector.start(INTERLEAVED, 7471.0, 105.0)
        took_ns = time.time_ns() - before_ns
        assert abs(start_ns - bench.read().start_ns) <= took_ns + 1_000_000

    def test_state_follows_start_and_stop(self, projector: Projector, bench: Bench) -> None:
        projector.load([INTERLEAVED])
        assert not projector.status().running
        projector.start(INTERLEAVED, 7471.0, 105.0)
        assert projector.status().running
        assert bench.read().running
        projector.stop()
        assert not projector.status().running
        assert not bench.read().running
        projector.stop()  # twice is as good as once

    def test_close_takes_the_light_away(self, projector: Projector, bench: Bench, uri: str, setting: Setting) -> None:
        other = open_projector(uri, setting)
        other.load([INTERLEAVED])
        other.start(INTERLEAVED, 7471.0, 105.0)
        assert bench.read().running
        other.close()
        assert not bench.read().running

    @pytest.mark.parametrize(("exposure_us", "dark_us"), [(4045.0, 105.0), (7471.0, 104.0), (7471.0, 0.0)])
    def test_times_too_short_are_refused_with_the_limit(
        self, projector: Projector, bench: Bench, exposure_us: float, dark_us: float
    ) -> None:
        projector.load([INTERLEAVED])
        with pytest.raises(DeviceError, match=r"4046|105"):
            projector.start(INTERLEAVED, exposure_us, dark_us)
        assert bench.read() == Shown() or not bench.read().running

    def test_the_limits_themselves_are_kept(self, projector: Projector, bench: Bench) -> None:
        limits = projector.limits
        projector.load([INTERLEAVED])
        projector.start(INTERLEAVED, limits.min_exposure_us, limits.min_dark_us)
        assert bench.read().running

    def test_a_set_that_was_not_loaded_is_refused(self, projector: Projector) -> None:
        projector.load([INTERLEAVED])
        with pytest.raises(DeviceError, match="not loaded"):
            projector.start(CONVENTIONAL, 7471.0, 105.0)

    def test_loading_replaces(self, projector: Projector, bench: Bench) -> None:
        projector.load([INTERLEAVED])
        projector.load([CONVENTIONAL])
        projector.start(CONVENTIONAL, 7471.0, 105.0)
        assert len(images(bench)) == len(CONVENTIONAL)
        with pytest.raises(DeviceError, match="not loaded"):
            projector.start(INTERLEAVED, 7471.0, 105.0)

    def test_an_unknown_option_is_named(self, uri: str, setting: Setting, projector: Projector) -> None:
        with pytest.raises(DeviceError, match="wrong"):
            open_projector(f"{uri}&wrong=1", setting)
