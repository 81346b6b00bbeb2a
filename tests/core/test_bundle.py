"""Bundle adjustment: exact on exact data, within its stated sigma on noisy data, unmoved by outliers."""

import cv2
import numpy as np
import pytest

from endo3d_core.calibrating.bundle import NAMES, Solution, solve
from endo3d_core.calibrating.sighting import Sighting
from endo3d_core.calibration import Lens, Rig

CAMERA_SIZE, PROJECTOR_SIZE = (1920, 1200), (960, 960)
TILTS_RAD = [(0.5 * np.cos(a), 0.5 * np.sin(a), 0.1 * a) for a in np.arange(12) * 2.4]


@pytest.fixture(scope="module")
def rig() -> Rig:
    K_camera = [[1988.4, 0, 953.4], [0, 1992.2, 603.9], [0, 0, 1]]
    K_projector = [[1545.6, 0, 484.7], [0, 1542.1, 476.8], [0, 0, 1]]
    camera = Lens(*CAMERA_SIZE, K_camera, [-0.127, 0.018, -5e-4, 3e-4, 0])
    projector = Lens(*PROJECTOR_SIZE, K_projector, [-0.088, -0.009, 4e-4, -2e-4, 0])
    R = cv2.Rodrigues(np.array([0.005, 0.296, -0.0065]))[0]
    return Rig(camera, projector, R, np.array([-5.93, 0.09, 0.84]))


def sightings(rig: Rig, noise_px: float, seed: int) -> list[Sighting]:
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(9) - 4.0, np.arange(7) - 3.0)
    board = np.stack((x.ravel(), y.ravel(), np.zeros(x.size)), axis=1)
    seen = []
    for index, tilt in enumerate(TILTS_RAD):
        R = cv2.Rodrigues(np.array(tilt))[0]
        points = board @ R.T + np.array(
            [0.3 * np.cos(index), 0.3 * np.sin(index), 20 + 1.5 * np.sin(1.7 * index)]
        )
        camera, projector = rig.camera.project(points), rig.projector_pixel(points)
        seen.append(
            Sighting(
                f"pose{index}",
                board,
                camera + rng.normal(0, noise_px, camera.shape),
                projector + rng.normal(0, noise_px, projector.shape),
            )
        )
    return seen


def parameters(rig: Rig) -> dict[str, float]:
    values = []
    for lens in (rig.camera, rig.projector):
        values += [lens.K[0, 0], lens.K[1, 1], lens.K[0, 2], lens.K[1, 2], *lens.dist]
    values += [*cv2.Rodrigues(rig.R)[0].ravel(), *rig.t]
    return dict(zip(NAMES, values, strict=True))


def test_exact_features_give_the_exact_rig(rig: Rig) -> None:
    solution = solve(sightings(rig, 0.0, 0), CAMERA_SIZE, PROJECTOR_SIZE)
    truth = parameters(rig)
    for name, value in parameters(solution.rig).items():
        assert value == pytest.approx(truth[name], rel=1e-7, abs=1e-7), name
    assert max(solution.rms_px) < 1e-7


def standardised(solution: Solution, rig: Rig) -> np.ndarray:
    found, truth = parameters(solution.rig), parameters(rig)
    return np.array([(found[name] - truth[name]) / sigma for name, sigma in solution.sigma.items()])


def test_errors_are_as_large_as_stated(rig: Rig) -> None:
    errors = np.concatenate(
        [
            standardised(solve(sightings(rig, 0.05, seed), CAMERA_SIZE, PROJECTOR_SIZE), rig)
            for seed in range(8)
        ]
    )
    assert np.all(np.abs(errors) < 4.5)  # 176 values: 4.5 sigma is passed by chance once in a thousand runs
    assert 0.8 < np.std(errors) < 1.2


def test_wild_features_hardly_move_the_rig(rig: Rig) -> None:
    clean = sightings(rig, 0.05, 3)
    rng = np.random.default_rng(4)
    wild = []
    for sighting in clean:
        projector = sighting.projector_px.copy()
        chosen = rng.choice(len(projector), 2, replace=False)
        projector[chosen] += rng.uniform(-40, 40, (2, 2))
        wild.append(Sighting(sighting.name, sighting.board_mm, sighting.camera_px, projector))
    errors = standardised(solve(wild, CAMERA_SIZE, PROJECTOR_SIZE), rig)
    assert np.all(np.abs(errors) < 5)


def test_too_few_poses_are_refused(rig: Rig) -> None:
    with pytest.raises(ValueError, match="at least 3"):
        solve(sightings(rig, 0.0, 0)[:2], CAMERA_SIZE, PROJECTOR_SIZE)


def test_a_board_that_never_tilts_leaves_the_focal_length_unknown(rig: Rig) -> None:
    flat = []
    for index, sighting in enumerate(sightings(rig, 0.0, 0)[:5]):
        points = sighting.board_mm + np.array([0.0, 0.0, 19.0 + 0.5 * index])
        noise = np.random.default_rng(index).normal(0, 0.05, (2, len(points), 2))
        camera, projector = rig.camera.project(points) + noise[0], rig.projector_pixel(points) + noise[1]
        flat.append(Sighting(sighting.name, sighting.board_mm, camera, projector))
    tilted = solve(sightings(rig, 0.05, 1)[:5], CAMERA_SIZE, PROJECTOR_SIZE)
    untilted = solve(flat, CAMERA_SIZE, PROJECTOR_SIZE)
    assert untilted.sigma["camera.fx"] > 10 * tilted.sigma["camera.fx"]
