"""Every part of the image formation against what optics says of it, and the fibre's look against real ones."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter
from scipy.spatial import cKDTree

from endo3d_core import patterns
from endo3d_core.calibration import Rig
from endo3d_core.head import Head
from endo3d_core.virtual_rig import bundle, defocus, motion, scene
from endo3d_core.virtual_rig.bundle import Bundle
from endo3d_core.virtual_rig.effects import FULL, IDEAL, Effects
from endo3d_core.virtual_rig.renderer import Renderer

HEAD_YAML = (Path(__file__).parents[2] / "deploy" / "heads" / "base6_wd20.yaml").read_text()
REAL = Path(os.environ.get("ENDO3D_TEST_IMAGES", Path(__file__).parents[3] / "shared" / "data")) / "fibre_bundle"
Image = NDArray[np.float32]


@cache
def a_bundle() -> Bundle:
    return Bundle(360, 360, 350.0, 5.0, 1.2, 1)


def image_of(text: str, effects: Effects, *, bin_px: int = 4, poses: int = 1, light: int = 255) -> Image:
    """(height, width) relative exposure under an even light."""
    rig = Rig.from_yaml(HEAD_YAML)
    renderer = Renderer(rig, Head.from_yaml(HEAD_YAML), scene.parse(text), effects, bin_px=bin_px)
    window = rig.projector
    shown = renderer.light(np.full((window.height, window.width), light, np.uint8))
    out = np.zeros(renderer.camera.height * renderer.camera.width, np.float32)
    path = motion.parse("stage v=10 along=x").T_scene_camera
    out[renderer.where] = renderer.exposure(shown, [path(0.01 * k) for k in range(poses)])
    return out.reshape(renderer.camera.height, renderer.camera.width)


def only(*names: str) -> Effects:
    return Effects(**{name: name in names for name in IDEAL.__dataclass_fields__})


# The fibre


def test_an_even_field_keeps_its_mean_through_the_bundle() -> None:
    cores = a_bundle().transmit(np.ones((360, 360), np.float32))
    assert cores.mean() == pytest.approx(1.0, abs=0.02)
    middle = a_bundle().image(cores)[90:270, 90:270]
    assert middle.mean() == pytest.approx(1.0, abs=0.02)


def test_cores_differ_as_much_as_stated() -> None:
    cores = a_bundle().transmit(np.ones((360, 360), np.float32))
    inner = np.hypot(*(a_bundle().cores - 179.5).T) < 120
    assert np.log(cores[inner]).std() == pytest.approx(bundle.GAIN_SIGMA, abs=0.01)


def test_one_lit_core_leaks_the_stated_shares() -> None:
    """What a single bright core sends to its neighbours, ring by ring."""
    b = a_bundle()
    lit = int(np.argmin(np.hypot(*(b.cores - 179.5).T)))
    image = np.zeros((360, 360), np.float32)
    u, v = np.rint(b.cores[lit]).astype(int)
    image[v - 1 : v + 2, u - 1 : u + 2] = 1.0
    without = b.transmit(image, crosstalk=False) / b.gain
    leaked = b.transmit(image) / b.gain
    assert np.count_nonzero(without) == 1
    leaked /= without[lit]
    order = np.argsort(np.hypot(*(b.cores - b.cores[lit]).T))
    assert leaked[order[0]] == pytest.approx(1 - 6 * 0.04 - 12 * 0.004 - 0.03, abs=0.003)
    assert leaked[order[1:7]].mean() == pytest.approx(0.04, abs=0.003)
    assert leaked[order[7:19]].mean() == pytest.approx(0.004, abs=0.001)
    # The tail: its share, spread over some pitches.
    assert leaked.sum() == pytest.approx(1.0, abs=0.02)


def look(image: NDArray[np.float64]) -> dict[str, float]:
    """Pitch, and in units of it or of the mean: the cores' spacing, its spread, the spread of their brightness."""
    flat = image / gaussian_filter(image, 20)
    window = np.hanning(flat.shape[0])[:, None] * np.hanning(flat.shape[1])
    power = np.abs(np.fft.fft2((flat - flat.mean()) * window)) ** 2
    fv, fu = np.meshgrid(*(np.fft.fftfreq(n) for n in flat.shape), indexing="ij")
    ring = (np.hypot(fu, fv) * 512).astype(int).ravel()
    mean = np.bincount(ring, power.ravel()) / np.maximum(np.bincount(ring), 1)
    mean[: int(0.05 * 512)] = 0.0
    pitch = 512 / (np.argmax(mean[:256]) + 0.5) * 2 / np.sqrt(3)
    fine = gaussian_filter(cv2.resize(flat, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC), 0.72 * pitch)
    peaks = fine == maximum_filter(fine, int(2.4 * pitch) | 1)
    at, height = np.argwhere(peaks) / 4, fine[peaks]
    inner = (at.min(axis=1) > 10) & (at[:, 0] < flat.shape[0] - 10) & (at[:, 1] < flat.shape[1] - 10)
    spacing = cKDTree(at).query(at[inner], 7)[0][:, 1:]
    return {
        "pitch": pitch,
        "spacing": float(np.median(spacing)) / pitch,
        "spacing spread": spacing.std() / spacing.mean(),
        "brightness spread": height[inner].std() / height[inner].mean(),
        "contrast": flat.std() / flat.mean(),
    }


@pytest.mark.parametrize("name", ["FujikuraHD1", "usaf1_background", "usaf_1_background"])
def test_the_fibre_looks_like_a_real_one(name: str) -> None:
    """Statistics of real bundles under even light, beside ours at the same pitch."""
    if not (REAL / f"{name}.png").exists():
        pytest.skip("the real images through fibre bundles are not here (ENDO3D_TEST_IMAGES)")
    photo = cv2.imread(str(REAL / f"{name}.png"), cv2.IMREAD_GRAYSCALE)
    v, u = photo.shape[0] // 2, photo.shape[1] // 2
    real = look(photo[v - 150 : v + 150, u - 200 : u + 200].astype(np.float64))
    ours = Bundle(600, 600, 580.0, real["pitch"], 0.8 * real["pitch"] / 3.414, 1)
    simulated = look(ours.image(ours.transmit(np.ones((600, 600), np.float32)))[150:450, 100:500].astype(np.float64))
    assert simulated["pitch"] == pytest.approx(real["pitch"], rel=0.05)
    assert simulated["spacing"] == pytest.approx(real["spacing"], rel=0.05)
    assert simulated["spacing spread"] == pytest.approx(real["spacing spread"], rel=0.35)
    assert simulated["brightness spread"] == pytest.approx(real["brightness spread"], rel=0.45)
    # The photographs are softer or sharper by their own relay.
    assert 0.5 < simulated["contrast"] / real["contrast"] < 2.2


# Defocus


@pytest.mark.parametrize("sigma_px", [0.4, 0.9, 1.7, 2.9])
def test_blur_has_the_asked_variance(sigma_px: float) -> None:
    """Second moment of a point, for a blur between the levels."""
    point = np.zeros((65, 65), np.float32)
    point[32, 32] = 1.0
    blurred = defocus.blur(point, np.full((65, 65), sigma_px**2, np.float32)).astype(np.float64)
    d = np.arange(65) - 32.0
    assert blurred.sum() == pytest.approx(1.0, abs=1e-3)
    assert (blurred.sum(axis=0) * d**2).sum() == pytest.approx(sigma_px**2, rel=0.06, abs=0.02)


def edge_width_px(image: Image) -> float:
    """Sigma of a vertical edge in the middle row, from the second moment of its slope."""
    row = image[image.shape[0] // 2, :].astype(np.float64)
    slope = np.abs(np.diff(row))
    middle = image.shape[1] // 2
    at = np.arange(slope.size)
    edge = middle - 40 + int(np.argmax(slope[middle - 40 : middle + 40]))
    near = slope * (np.abs(at - edge) < 15)
    centre = (near * at).sum() / near.sum()
    return float(np.sqrt((near * (at - centre) ** 2).sum() / near.sum()))


def test_the_camera_blurs_as_far_out_of_focus_as_the_head_says() -> None:
    """A checker's edge on the axis 3 mm behind the focus: sigma = k dz, in pixels of the camera."""
    z = 23.2
    text = f"plane z={z} texture=checker:0.9:5"
    sharp = edge_width_px(image_of(text, IDEAL, bin_px=1))
    blurred = edge_width_px(image_of(text, only("camera_defocus"), bin_px=1))
    rig, head = Rig.from_yaml(HEAD_YAML), Head.from_yaml(HEAD_YAML)
    expected = head.defocus_per_mm * (z - defocus.focus_mm(head)) * rig.camera.K[0, 0] / z
    assert np.sqrt(blurred**2 - sharp**2) == pytest.approx(expected, rel=0.15)


def test_the_projector_s_fringes_fade_out_of_focus() -> None:
    """Modulation of a fine pattern falls by exp(-sigma^2 k^2 / 2)."""
    rig, head = Rig.from_yaml(HEAD_YAML), Head.from_yaml(HEAD_YAML)
    n, frequency = rig.projector.width, 160.0
    k = 2 * np.pi * frequency / n
    modulation: dict[float, float] = {}
    for z in (defocus.focus_mm(head), defocus.focus_mm(head) + 3.0):
        renderer = Renderer(rig, head, scene.parse(f"plane z={z}"), only("projector_defocus"), bin_px=4)
        waves = [
            renderer.exposure(renderer.light(patterns.image(p, n, n)), [np.eye(4)]).copy()
            for p in patterns.conventional((frequency,), (4,)).patterns
        ]
        near = np.abs(renderer.where % renderer.camera.width - renderer.camera.width / 2) < 10
        near &= np.abs(renderer.where // renderer.camera.width - renderer.camera.height / 2) < 10
        a, b, c, d = (wave[near] for wave in waves)
        modulation[z] = float(np.median(2 * np.hypot(a - c, b - d) / (a + b + c + d)))
    ratio = modulation[max(modulation)] / modulation[min(modulation)]
    off_mm = rig.to_projector((0.0, 0.0, defocus.focus_mm(head) + 3.0))[2] - defocus.focus_mm(head)
    sigma = head.defocus_per_mm * off_mm * rig.projector.K[0, 0] / defocus.focus_mm(head)
    assert ratio == pytest.approx(np.exp(-((sigma * k) ** 2) / 2), rel=0.1)


# Light


def test_vignetting_is_cos4_and_the_stated_loss() -> None:
    ratio = image_of("plane", only("vignetting")) / np.maximum(image_of("plane", IDEAL), 1e-9)
    h, w = ratio.shape
    edge = ratio[h // 2, w // 2 - 147 : w // 2 - 143].mean()  # at 0.97 of the field's radius
    assert ratio[h // 2, w // 2] == pytest.approx(1.0, abs=0.01)
    assert edge == pytest.approx(0.84**0.94 * (1 - 0.4 * 0.94), abs=0.02)


def test_ambient_light_is_there_without_the_projector() -> None:
    dark = image_of("plane albedo=0.5", IDEAL, light=0)
    assert dark.max() == 0.0
    ambient = image_of("plane albedo=0.5", only("ambient"), light=0)
    assert ambient[ambient > 0].mean() == pytest.approx(0.5 * 0.02, rel=1e-3)


def test_a_metal_surface_shines_where_the_mirror_law_says() -> None:
    """The brightest spot of a metal sphere has its normal halfway between camera and projector."""
    rig = Rig.from_yaml(HEAD_YAML)
    shine = image_of("sphere r=3 at=0,0,21 surface=metal", only("specular"), bin_px=2)
    shine -= image_of("sphere r=3 at=0,0,21 surface=metal", IDEAL, bin_px=2)
    v, u = np.unravel_index(np.argmax(gaussian_filter(shine, 2)), shine.shape)
    ray = rig.camera.binned(2).ray(np.array((u, v), np.float64))
    b, c = ray @ (0, 0, 21.0), 21.0**2 - 9.0
    point = ray * (b - np.sqrt(b**2 - (ray @ ray) * c)) / (ray @ ray)
    normal = (point - (0, 0, 21.0)) / 3.0
    to_lamp = rig.projector_centre_mm - point
    half = to_lamp / np.linalg.norm(to_lamp) - point / np.linalg.norm(point)
    assert normal @ half / np.linalg.norm(half) > np.cos(np.radians(4.0))


def test_a_shadow_is_dark_and_can_be_switched_off() -> None:
    text = "plane z=21 + sphere r=0.8 at=0,0,19"
    lit, shaded = image_of(text, IDEAL), image_of(text, only("shadows"))
    darker = (lit > 0.3) & (shaded == 0.0)
    assert 100 < darker.sum() < 3000
    assert np.array_equal(lit[~darker], shaded[~darker])


def test_motion_blur_is_the_mean_of_the_poses() -> None:
    """And only moving heads have several."""
    text = "plane texture=checker:0.5:1"
    rig, head = Rig.from_yaml(HEAD_YAML), Head.from_yaml(HEAD_YAML)
    renderer = Renderer(rig, head, scene.parse(text), only("motion_blur"), bin_px=4)
    assert len(renderer.poses(motion.parse("still").T_scene_camera, 0.0, 5000.0)) == 1
    moving = renderer.poses(motion.parse("stage v=100 along=x").T_scene_camera, 1.0, 8000.0)
    assert [pose[0, 3] for pose in moving] == pytest.approx([99.7, 99.9, 100.1, 100.3])
    light = renderer.light(np.full((rig.projector.height, rig.projector.width), 255, np.uint8))
    each = [renderer.exposure(light, [pose]).copy() for pose in moving]
    assert np.allclose(renderer.exposure(light, moving), np.mean(each, axis=0), atol=1e-5)


def test_every_effect_can_be_switched_off_alone() -> None:
    """Each switch changes the image, and only what is switched on takes part."""
    text = "sphere r=3 at=0,0,21 surface=metal + plane z=23 tilt=10"
    full = image_of(text, FULL, poses=3)
    for name in IDEAL.__dataclass_fields__:
        if name in ("noise", "quantisation", "motion_blur"):
            continue  # of the sensor, and of the poses: tested by themselves
        without = image_of(text, FULL.without(name), poses=3)
        assert np.abs(without - full).max() > 1e-3, name
    with pytest.raises(ValueError, match="unknown effect 'glare'"):
        FULL.without("glare")


def test_frames_repeat_to_the_bit_whatever_the_threads() -> None:
    rig, head = Rig.from_yaml(HEAD_YAML), Head.from_yaml(HEAD_YAML)
    frames = []
    for threads in (1, 2):
        renderer = Renderer(rig, head, scene.parse("contour"), FULL, bin_px=2, threads=threads)
        image = np.empty((600, 960), np.uint8)
        n = rig.projector.width
        light = renderer.light(patterns.image(patterns.interleaved(15)[0], n, n))
        renderer.frame(light, [np.eye(4)], 5000.0, 42, image)
        frames.append(image)
    assert np.array_equal(*frames)
    assert 20 < frames[0].max() <= 255
