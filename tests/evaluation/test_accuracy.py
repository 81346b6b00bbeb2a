"""What the continuous mode promises of its points, on simulated noisy frames: `endo3d evaluate decode` in small."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from endo3d.services.evaluation import decode
from endo3d.services.evaluation.measure import Settings


@pytest.fixture(scope="module")
def figures(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return decode.evaluate(Settings(tmp_path_factory.mktemp("decode"), quick=True)).figures


@pytest.mark.slow
def test_a_sphere_of_1_mm_keeps_its_size_and_form(figures: dict[str, Any]) -> None:
    """Four fringes across: the band-pass alone is off by 10 um here, a Fourier transform of the row by 134."""
    found = figures["sphere R 1 mm, still, reuse + fit"]
    assert abs(found["radius_um"]) <= 3.0
    assert found["form_um"] <= 4.5
    assert abs(figures["sphere R 1 mm, still, reuse"]["radius_um"]) > 5.0


@pytest.mark.slow
def test_planes_and_prints_are_flat(figures: dict[str, Any]) -> None:
    assert figures["plane, still, reuse + fit"]["rms_um"] <= 1.5
    assert figures["texture, still, reuse + fit"]["rms_um"] <= 3.0


@pytest.mark.slow
def test_fringe_orders_are_right(figures: dict[str, Any]) -> None:
    assert figures["plane, axial 40 um/frame, reuse + fit"]["wrong"] == 0.0
    assert figures["steps, still, reuse + fit"]["wrong"] < 0.1


@pytest.mark.slow
def test_a_step_is_sharp(figures: dict[str, Any]) -> None:
    assert figures["step of 0.5 mm, still, reuse + fit"]["step_px"] <= 4.0


def test_the_step_response_of_known_edges() -> None:
    """A ramp of 4 px has 3.2 px between 10 and 90 %; what is missing counts."""
    x = np.arange(60)
    truth = np.tile(np.where(x < 30, 1.0, 2.0), (120, 1))
    ramp = np.tile(np.clip(1.0 + (x - 28.0) / 4.0, 1.0, 2.0), (120, 1)).astype(np.float32)
    assert decode.step_response_px(ramp, truth) == pytest.approx(3.2, abs=0.01)
    gap = np.where((x > 26) & (x < 33), np.nan, truth).astype(np.float32)
    assert decode.step_response_px(gap, truth) == pytest.approx(0.8 * 7, abs=0.01)
