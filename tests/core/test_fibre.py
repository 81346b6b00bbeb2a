"""Fibre cores: a made bundle whose cores are known, and real ones."""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from endo3d_core import fibre
from endo3d_core.fibre import CoreMap, Crosstalk
from endo3d_core.fibre_operator import FibreOperator

REAL = Path(__file__).parents[2].parent / "shared" / "data" / "fibre_bundle"
SPACING = 4.2


def _npz(**arrays: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


NPZ_OF_SOMETHING_ELSE = _npz(points=np.zeros((3, 3)))


def bundle(  # type: ignore[no-untyped-def]
    scene, leak: float = 0.04, level: float = 80.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(image of the scene, image of a flat, cores) through a jittered hexagonal bundle; ``scene(x, y)`` 0..1."""
    rng = np.random.default_rng(5)
    rows = np.arange(4, 296, SPACING * np.sqrt(3) / 2)
    cores = np.array([(x + (i % 2) * SPACING / 2, y) for i, y in enumerate(rows) for x in np.arange(4, 290, SPACING)])
    cores = cores + rng.normal(0, 0.05 * SPACING, cores.shape)
    gain = rng.lognormal(0, 0.12, len(cores))
    distance, index = cKDTree(cores).query(cores, 7)
    near = distance[:, 1:] < 1.5 * SPACING
    v, u = np.mgrid[0:300, 0:300]
    images = []
    for light, grey in ((scene(cores[:, 0], cores[:, 1]), level), (np.ones(len(cores)), 80.0)):
        leaked = (1.0 - leak * near.sum(axis=1)) * light + leak * (near * light[index[:, 1:]]).sum(axis=1)
        image = np.zeros((300, 300))
        for (x, y), value in zip(cores, gain * leaked, strict=True):
            box = np.s_[max(0, int(y) - 4) : int(y) + 6, max(0, int(x) - 4) : int(x) + 6]
            image[box] += value * np.exp(-((u[box] - x) ** 2 + (v[box] - y) ** 2) / (2 * 1.0**2))
        images.append(np.clip(np.rint(grey * image + rng.normal(0, 0.5, image.shape)), 0, 255).astype(np.uint8))
    return images[0], images[1], cores


def operator_for(flat: np.ndarray, leak: float = 0.0, **options: float) -> FibreOperator:
    return FibreOperator(CoreMap.find(flat, Crosstalk(leak, 0.0, 0.0)), 2, **options)


def resample(operator: FibreOperator, image: np.ndarray) -> np.ndarray:
    out = np.empty(operator.shape, np.float32)
    operator(image, out)
    return out


def fringes(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 0.5 + 0.5 * np.cos(2 * np.pi * x / 30)


def test_every_core_is_found_to_a_fraction_of_a_pixel() -> None:
    _, flat, cores = bundle(fringes)
    assert fibre.core_spacing(flat) == pytest.approx(SPACING, rel=0.05)
    inner = cores[(np.abs(cores - 150) < 130).all(axis=1)]
    distance = cKDTree(fibre.find_cores(flat)).query(inner)[0]
    assert np.mean(distance < 1.0) > 0.95
    assert np.median(distance) < 0.35


def test_the_honeycomb_goes_and_the_gain_with_it() -> None:
    """A flat becomes flat: the cores' 12 % of gain and the dark between them are gone."""
    _, flat, _ = bundle(fringes)
    seen = resample(operator_for(flat), flat)[20:-20, 20:-20]
    assert np.std(flat[40:-40, 40:-40]) / np.mean(flat[40:-40, 40:-40]) > 0.15
    assert np.std(seen) / np.mean(seen) < 0.02
    assert np.mean(seen) == pytest.approx(np.mean(flat[40:-40, 40:-40]), rel=0.04)


def test_the_contrast_comes_back() -> None:
    """Averages, interpolation and a leak of 6 x 8 % take a seventh of the contrast of short fringes."""
    image, flat, _ = bundle(lambda x, y: 0.5 + 0.5 * np.cos(2 * np.pi * x / 22), leak=0.08)

    def contrast(leak: float) -> float:
        seen = resample(operator_for(flat, leak), image)[30:-30, 30:-30].mean(axis=0)
        phase = 2 * np.pi * ((np.arange(seen.size) + 30.5) * 2.0 - 0.5) / 22
        return float(2 * np.abs(np.mean(seen * np.exp(-1j * phase))) / seen.mean())

    assert contrast(0.0) < 0.9
    assert contrast(0.08) == pytest.approx(1.0, abs=0.03)


def test_light_that_leaks_from_a_highlight_no_longer_moves_the_fringes() -> None:
    """Beside a highlight every blur mixes in its brighter phase; four phase steps show by how much."""
    x = 2.0 * np.arange(150) + 0.5
    phase = 2 * np.pi * x / 30

    def scene(shift: float):  # type: ignore[no-untyped-def]
        return lambda x, y: (
            (0.1 + 0.9 * np.exp(-(((x - 150) / 12) ** 2))) * (0.5 + 0.5 * np.cos(2 * np.pi * x / 30 + shift))
        )

    images = [bundle(scene(0.5 * np.pi * k), leak=0.06, level=120.0) for k in range(4)]

    def errors(leak: float) -> np.ndarray:
        operator = operator_for(images[0][1], leak)
        g = [resample(operator, image)[20:-20].mean(axis=0) for image, _, _ in images]
        found = np.angle((g[0] - g[2] + 1j * (g[3] - g[1])) * np.exp(-1j * phase))
        flanks = (np.abs(x - 150) > 8) & (np.abs(x - 150) < 22)
        return np.asarray(found[flanks])

    assert np.std(errors(0.0)) > 0.05
    assert np.std(errors(0.06)) < 0.35 * np.std(errors(0.0))


def test_a_clipped_core_is_known_from_its_rim_and_one_that_is_not_becomes_infinite() -> None:
    def spot(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 0.4 + 0.6 * np.exp(-(((x - 150) / 25) ** 2) - ((y - 150) / 25) ** 2)

    dim, flat, _ = bundle(spot, level=80.0)
    bright, _, _ = bundle(spot, level=300.0)
    operator = operator_for(flat)
    expected, seen = resample(operator, dim) * (300.0 / 80.0), resample(operator, bright)
    inner = np.s_[20:-20, 20:-20]
    known = np.isfinite(seen[inner])
    assert (bright[140:160, 140:160] == 255).mean() > 0.02
    assert known.mean() > 0.95
    relative = seen[inner][known] / expected[inner][known] - 1.0
    assert np.std(relative) < 0.03
    blinding = np.where(flat > 8, 255, 0).astype(np.uint8)
    assert np.isinf(resample(operator, blinding)[inner]).mean() > 0.9


@pytest.mark.parametrize("factor", [1, 2])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_words_of_four_pixels_give_what_single_pixels_give(factor: int, dtype: type) -> None:
    """The quick loops against the general one, which any other dtype takes."""
    _, flat, _ = bundle(fringes)
    rng = np.random.default_rng(0)
    found = CoreMap.find(flat)
    core_map = CoreMap(found.flat, found.cores, 3.4).binned(factor)
    full = np.iinfo(dtype).max
    operator = FibreOperator(core_map, 2, saturation_grey=0.98 * full)
    image = rng.integers(0, full + 1, operator.image_shape).astype(dtype)
    quick, general = resample(operator, image), resample(operator, image.astype(np.float64))
    np.testing.assert_array_equal(np.isinf(quick), np.isinf(general))
    known = np.isfinite(quick)
    assert known.mean() > 0.5
    np.testing.assert_allclose(quick[known], general[known], atol=2e-4 * full)


def test_a_camera_that_bins_needs_no_other_map() -> None:
    image, flat, _ = bundle(lambda x, y: 0.5 + 0.4 * np.cos(2 * np.pi * x / 60))
    halves = image.reshape(150, 2, 150, 2).mean(axis=(1, 3))
    core_map = CoreMap.find(flat)
    full, binned = FibreOperator(core_map, 4), FibreOperator(core_map.binned(2), 2)
    inner = np.s_[8:-8, 8:-8]
    a, b = resample(full, image)[inner], resample(binned, np.rint(halves).astype(np.uint8))[inner]
    assert np.std(a - b) / np.mean(a) < 0.03


def test_a_core_map_survives_its_file() -> None:
    _, flat, _ = bundle(fringes)
    before = CoreMap.find(flat, Crosstalk(0.05, 0.003, 0.02, 3.0))
    after = CoreMap.from_npz(before.to_npz())
    np.testing.assert_allclose(after.cores, before.cores, atol=1e-4)
    np.testing.assert_allclose(after.flat, before.flat, atol=0.5 / fibre.FLAT_STEPS)
    assert (after.spacing_px, after.crosstalk) == (before.spacing_px, before.crosstalk)


@pytest.mark.parametrize("file", [b"", b"PK nonsense", NPZ_OF_SOMETHING_ELSE])
def test_another_file_is_no_core_map(file: bytes) -> None:
    with pytest.raises(ValueError, match="no map of fibre cores"):
        CoreMap.from_npz(file)


def test_an_image_without_cores_says_so() -> None:
    with pytest.raises(ValueError, match="honeycomb"):
        fibre.core_spacing(np.full((300, 300), 100, np.uint8))


def test_a_frame_of_another_size_says_so() -> None:
    _, flat, _ = bundle(fringes)
    with pytest.raises(ValueError, match="300"):
        operator_for(flat)(np.zeros((200, 200), np.uint8), np.zeros((150, 150), np.float32))


@pytest.mark.parametrize(("name", "least"), [("FujikuraHD1.png", 2000), ("usaf_1_background.png", 5000)])
def test_real_bundles(name: str, least: int) -> None:
    """Neighbours stand one spacing apart, as they do in a bundle."""
    path = REAL / name
    if not path.exists():
        pytest.skip(f"no real fibre images at {REAL}")
    flat = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    spacing = fibre.core_spacing(flat)
    assert 2.5 < spacing < 8.5
    cores = fibre.find_cores(flat)
    assert len(cores) > least
    nearest = cKDTree(cores).query(cores, 2)[0][:, 1]
    assert 0.75 * spacing < np.median(nearest) < 1.15 * spacing
    operator = FibreOperator(CoreMap.find(flat, fibre.NO_CROSSTALK), max(1, round(0.9 * spacing)))
    seen = resample(operator, flat)
    inner = operator.inside & (cv2.erode(operator.inside.astype(np.uint8), np.ones((31, 31))) > 0)
    even = seen[inner] / cv2.GaussianBlur(seen, (0, 0), 12.0)[inner]  # the lamp's course stays
    assert np.ptp(np.quantile(even, (0.05, 0.95))) < 0.1
