"""Sequences as data: the text, the images, what is refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from endo3d_core import patterns
from endo3d_core.patterns import Pattern

TEXTS = [
    "interleaved f1=25",
    "interleaved f1=15 axis=rows wave=binary",
    "conventional f=50/49/43 steps=4/2/2",
    "conventional f=50/49/43 steps=4/2/2 exposures_us=10200/40800/163200",
    "conventional f=50/49/43 steps=8/4/4 gamma=2.2",
    "sequence f=28.8/28.8/28.8/19.2/19.2/19.2 shifts=-2.0943951023931953/0/2.0943951023931953/0/1/2",
]


@pytest.mark.parametrize("text", TEXTS)
def test_the_canonical_text_parses_back(text: str) -> None:
    assert patterns.parse(text).text == text
    assert patterns.parse(patterns.parse(text).text) == patterns.parse(text)


frequency = st.floats(2.0, 200.0)


@given(f1=frequency, gamma=st.floats(0.3, 3.0), axis=st.sampled_from(["columns", "rows"]))
def test_any_set_survives_its_text(f1: float, gamma: float, axis: patterns.Axis) -> None:
    made = patterns.interleaved(f1, axis=axis, gamma=gamma)
    assert patterns.parse(made.text) == made


def test_any_three_neighbours_of_the_interleaved_period_decode() -> None:
    period = patterns.interleaved(25)
    for k in range(4):
        before, centre, after = period[k - 1], period[k], period[k + 1]
        assert before.frequency == after.frequency
        assert abs(before.shift_rad - after.shift_rad) == math.pi
        assert abs(centre.frequency - before.frequency) == 1.0


def test_an_image_is_equation_2_to_half_a_grey_value() -> None:
    shown = patterns.image(Pattern(25.0, 0.7), 1920, 8)
    x = np.arange(1920)
    wanted = 255 * (0.5 + 0.5 * np.cos(2 * np.pi * 25 * x / 1920 + 0.7))
    assert shown.shape == (8, 1920)
    assert np.abs(shown[3] - wanted).max() <= 0.5


def test_rows_are_columns_turned() -> None:
    columns = patterns.image(Pattern(10.0, 0.3, "columns"), 640, 480)
    rows = patterns.image(Pattern(10.0, 0.3, "rows"), 480, 640)
    np.testing.assert_array_equal(rows, columns.T)


def test_a_binary_pattern_is_the_sines_sign() -> None:
    sine, binary = (patterns.image(Pattern(25.0, 0.1, wave=wave), 1920, 1)[0] for wave in ("sine", "binary"))
    assert set(np.unique(binary)) == {0, 255}
    np.testing.assert_array_equal(binary == 255, sine >= 128)


def test_precompensation_makes_the_light_a_sine() -> None:
    shown = patterns.image(Pattern(5.0, 0.0, gamma=2.2), 1920, 1)[0] / 255.0
    light = shown**2.2
    wanted = patterns.profile(Pattern(5.0, 0.0), np.arange(1920), 1920)
    assert np.abs(light - wanted).max() < 2.2 * 0.5 / 255 + 1e-6


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "unknown pattern set"),
        ("gray bits=8", "unknown pattern set"),
        ("interleaved f1=1", "f1 > 1"),
        ("interleaved", "no f1="),
        ("interleaved f1=25 f1=26", "is not key=value"),
        ("interleaved f1=25 steps=4", "is not key=value"),
        ("interleaved f1=nan", "finite"),
        ("interleaved f1=25 axis=diagonal", "axis is"),
        ("conventional f=50/49/43 steps=2/2/2", "three steps"),
        ("conventional f=50/49 steps=4/2/2", "one step count"),
        ("conventional f=50/50 steps=4/2", "distinct"),
        ("conventional f=50/49/43 steps=12/4/4", "at most 16"),
        ("sequence f=50/50 shifts=0", "one shift"),
    ],
)
def test_a_wrong_text_says_what_is_wrong(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        patterns.parse(text)
