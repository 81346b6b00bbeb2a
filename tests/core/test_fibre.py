"""Fibre cores: a made bundle whose cores are known, and real ones."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from endo3d_core import fibre

REAL = Path(__file__).parents[2].parent / "shared" / "data" / "fibre_bundle"
SPACING = 4.2


def bundle(scene, leak: float = 0.04) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # type: ignore[no-untyped-def]
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
    for light in (scene(cores[:, 0], cores[:, 1]), np.ones(len(cores))):
        leaked = light + leak * (near * light[index[:, 1:]]).sum(axis=1)
        image = np.zeros((300, 300))
        for (x, y), value in zip(cores, gain * leaked, strict=True):
            box = np.s_[max(0, int(y) - 4) : int(y) + 6, max(0, int(x) - 4) : int(x) + 6]
            image[box] += value * np.exp(-((u[box] - x) ** 2 + (v[box] - y) ** 2) / (2 * 1.2**2))
        images.append(np.clip(np.rint(80 * image + rng.normal(0, 0.5, image.shape)), 0, 255).astype(np.uint8))
    return images[0], images[1], cores


def resample(operator: fibre.FibreOperator, image: np.ndarray) -> np.ndarray:
    out = np.empty(operator.grid_shape, np.float32)
    operator(image, out, np.empty(len(operator.cores), np.float32))
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
    seen = resample(fibre.build(flat, 2.0), flat)[20:-20, 20:-20]
    assert np.std(flat[40:-40, 40:-40]) / np.mean(flat[40:-40, 40:-40]) > 0.15
    assert np.std(seen) / np.mean(seen) < 0.02


def test_undoing_the_leak_gives_the_contrast_back() -> None:
    image, flat, _ = bundle(lambda x, y: 0.5 + 0.5 * np.cos(2 * np.pi * x / 22), leak=0.08)

    def contrast(leak_share: float) -> float:
        seen = resample(fibre.build(flat, 2.0, leak_share=leak_share), image)[30:-30, 30:-30].mean(axis=0)
        phase = 2 * np.pi * ((np.arange(seen.size) + 30.5) * 2.0 - 0.5) / 22
        return float(2 * np.abs(np.mean(seen * np.exp(-1j * phase))) / seen.mean())

    assert contrast(0.08) > 1.03 * contrast(0.0)


def test_an_image_without_cores_says_so() -> None:
    with pytest.raises(ValueError, match="honeycomb"):
        fibre.core_spacing(np.full((300, 300), 100, np.uint8))


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
    operator = fibre.build(flat, spacing)
    seen = resample(operator, flat)
    inner = operator.inside & (cv2.erode(operator.inside.astype(np.uint8), np.ones((31, 31))) > 0)
    assert np.std(seen[inner]) / np.mean(seen[inner]) < 0.05
