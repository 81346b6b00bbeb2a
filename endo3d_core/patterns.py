"""Pattern sequences as data: what the projector shows, slot by slot, and its canonical text.

A pattern's intensity at projector pixel x (0-based, of N along its axis) is 1/2 + 1/2 cos(2 pi f x / N +
shift), eq. (2) of the paper; a binary pattern is its sign. The text travels with every frame, so frames and a
calibration are all that decoding needs:

    interleaved f1=25                              (f1,0) (f1-1,0) (f1,pi) (f1-1,pi): any three in a row
    decode conventional f=50/49/43 steps=4/2/2            n-step highest frequency, two-step lower ones
    (Peng and Gupta) conventional f=50/49/43 steps=4/2/2 exposures_us=10200/40800/163200
    sequence f=28.8/28.8/19.2 shifts=0/1.57/0      any list, one frequency and one shift in rad per pattern

Options of every kind: ``axis=rows`` (the phase grows down the rows; columns is the default), ``wave=binary``,
``gamma=2.2`` (the projector emits grey^gamma: images are pre-compensated).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Axis = Literal["columns", "rows"]
Wave = Literal["sine", "binary"]
Kind = Literal["interleaved", "conventional", "sequence"]

TWO_PI = 2.0 * math.pi


@dataclass(frozen=True, slots=True)
class Pattern:
    """One slot of a sequence."""

    frequency: float
    """Periods over the projector's width (axis columns) or height (axis rows)."""
    shift_rad: float
    axis: Axis = "columns"
    wave: Wave = "sine"
    gamma: float = 1.0
    exposure_us: float | None = None
    """None: whatever the mode exposes with."""


@dataclass(frozen=True)
class PatternSet:
    """A periodic sequence; slot k shows ``patterns[k % len(patterns)]``."""

    kind: Kind
    patterns: tuple[Pattern, ...]

    def __len__(self) -> int:
        return len(self.patterns)

    def __getitem__(self, slot: int) -> Pattern:
        return self.patterns[slot % len(self.patterns)]

    @property
    def axis(self) -> Axis:
        return self.patterns[0].axis

    @cached_property
    def frequencies(self) -> tuple[float, ...]:
        """The distinct ones, in order of appearance."""
        return tuple(dict.fromkeys(pattern.frequency for pattern in self.patterns))

    @cached_property
    def exposures_us(self) -> tuple[float, ...]:
        """The distinct exposures of an HDR set, in order of appearance; empty when the mode decides."""
        return tuple(dict.fromkeys(p.exposure_us for p in self.patterns if p.exposure_us is not None))

    @property
    def text(self) -> str:
        """The canonical text; ``parse(set.text) == set``."""
        return format_text(self)


def image(pattern: Pattern, width: int, height: int) -> NDArray[np.uint8]:
    """(height, width) uint8: what the projector is given, rounded to the nearest grey value."""
    n = width if pattern.axis == "columns" else height
    line = np.rint(255.0 * profile(pattern, np.arange(n), n) ** (1.0 / pattern.gamma)).astype(np.uint8)
    shown = line[None, :] if pattern.axis == "columns" else line[:, None]
    return np.ascontiguousarray(np.broadcast_to(shown, (height, width)))


def profile(pattern: Pattern, position_px: NDArray[np.generic], n: int) -> NDArray[np.float64]:
    """Wanted light (0..1) at projector positions along the axis, ``n`` pixels long; positions may be
    fractions."""
    phase = TWO_PI * pattern.frequency * np.asarray(position_px, np.float64) / n + pattern.shift_rad
    wave = np.cos(phase)
    return 0.5 + 0.5 * (np.where(wave >= 0.0, 1.0, -1.0) if pattern.wave == "binary" else wave)


def interleaved(f1: float, *, axis: Axis = "columns", wave: Wave = "sine", gamma: float = 1.0) -> PatternSet:
    """The continuous mode's period of four (section 3.2, fig. 5)."""
    if not f1 > 1.0:
        raise ValueError(f"an interleaved sequence needs f1 > 1 (f2 = f1 - 1), not {f1:g}")
    order = ((f1, 0.0), (f1 - 1.0, 0.0), (f1, math.pi), (f1 - 1.0, math.pi))
    return PatternSet("interleaved", tuple(Pattern(f, shift, axis, wave, gamma) for f, shift in order))


def conventional(
    frequencies: tuple[float, ...],
    steps: tuple[int, ...],
    *,
    exposures_us: tuple[float, ...] = (),
    axis: Axis = "columns",
    wave: Wave = "sine",
    gamma: float = 1.0,
) -> PatternSet:
    """Section 3.1: n evenly spaced steps of the first frequency; two-step ones are 0 and pi/2 and share
    its background.

    With several exposures the whole list repeats, once per exposure.
    """
    if len(frequencies) != len(steps) or not frequencies:
        raise ValueError("a conventional sequence needs one step count per frequency: f=50/49/43 steps=4/2/2")
    if len(set(frequencies)) != len(frequencies) or min(frequencies) <= 0:
        raise ValueError("the frequencies of a conventional sequence must be positive and distinct")
    if steps[0] < 3 or min(steps) < 2:
        raise ValueError("the first frequency needs three steps or more (it carries the background), the others two")
    if not 3 <= sum(steps) <= 16:
        raise ValueError(f"a conventional sequence has at most 16 patterns, not {sum(steps)}")
    if any(exposure <= 0 for exposure in exposures_us):
        raise ValueError("exposures_us must be positive")
    shifts = [
        (f, TWO_PI * n / count if count > 2 else n * math.pi / 2)
        for f, count in zip(frequencies, steps, strict=True)
        for n in range(count)
    ]
    return PatternSet(
        "conventional",
        tuple(
            Pattern(f, shift, axis, wave, gamma, exposure)
            for exposure in exposures_us or (None,)
            for f, shift in shifts
        ),
    )


def sequence(
    frequencies: tuple[float, ...],
    shifts_rad: tuple[float, ...],
    *,
    exposures_us: tuple[float, ...] = (),
    axis: Axis = "columns",
    wave: Wave = "sine",
    gamma: float = 1.0,
) -> PatternSet:
    """Any list of patterns: one frequency, one shift and (if given) one exposure each."""
    if len(frequencies) != len(shifts_rad) or not frequencies:
        raise ValueError("a sequence needs one shift in rad per frequency: f=50/50/50 shifts=0/2.094/4.189")
    if exposures_us and len(exposures_us) != len(frequencies):
        raise ValueError("a sequence needs one exposure per pattern, or none")
    if min(frequencies) <= 0 or any(exposure <= 0 for exposure in exposures_us):
        raise ValueError("the frequencies and exposures of a sequence must be positive")
    exposures = exposures_us or (None,) * len(frequencies)
    return PatternSet(
        "sequence",
        tuple(
            Pattern(f, shift, axis, wave, gamma, exposure)
            for f, shift, exposure in zip(frequencies, shifts_rad, exposures, strict=True)
        ),
    )


_KEYS = {
    "interleaved": {"f1"},
    "conventional": {"f", "steps", "exposures_us"},
    "sequence": {"f", "shifts", "exposures_us"},
}
_OPTIONS = {"axis", "wave", "gamma"}
_AXES: dict[str, Axis] = {"columns": "columns", "rows": "rows"}
_WAVES: dict[str, Wave] = {"sine": "sine", "binary": "binary"}


@lru_cache(maxsize=64)
def parse(text: str) -> PatternSet:
    """Text -> set. Raises ``ValueError`` that says what is wrong."""
    kind, *words = text.split() or [""]
    if kind not in _KEYS:
        raise ValueError(f"unknown pattern set {text!r}; it starts with one of: {', '.join(_KEYS)}")
    values: dict[str, str] = {}
    for word in words:
        key, equals, value = word.partition("=")
        if not equals or key in values or key not in _KEYS[kind] | _OPTIONS:
            known = ", ".join(sorted(_KEYS[kind] | _OPTIONS))
            raise ValueError(f"pattern set {text!r}: {word!r} is not key=value with one of: {known}")
        values[key] = value
    axis, wave = _AXES.get(values.get("axis", "columns")), _WAVES.get(values.get("wave", "sine"))
    if axis is None or wave is None:
        raise ValueError(f"pattern set {text!r}: axis is columns or rows, wave is sine or binary")
    gamma = _floats(text, values, "gamma", (1.0,))[0]
    if not gamma > 0:
        raise ValueError(f"pattern set {text!r}: gamma must be positive")
    exposures = _floats(text, values, "exposures_us", ())
    if kind == "interleaved":
        return interleaved(_floats(text, values, "f1")[0], axis=axis, wave=wave, gamma=gamma)
    f = _floats(text, values, "f")
    if kind == "conventional":
        steps = tuple(int(step) for step in _floats(text, values, "steps"))
        return conventional(f, steps, exposures_us=exposures, axis=axis, wave=wave, gamma=gamma)
    shifts = _floats(text, values, "shifts")
    return sequence(f, shifts, exposures_us=exposures, axis=axis, wave=wave, gamma=gamma)


def format_text(pattern_set: PatternSet) -> str:
    """Set -> canonical text: the shortest that parses back to the same set."""
    patterns, first = pattern_set.patterns, pattern_set[0]
    match pattern_set.kind:
        case "interleaved":
            words = ["interleaved", f"f1={_text(first.frequency)}"]
        case "conventional":
            exposures = pattern_set.exposures_us
            once = patterns[: len(patterns) // max(1, len(exposures))]
            steps = [sum(p.frequency == f for p in once) for f in pattern_set.frequencies]
            words = ["conventional", f"f={_join(pattern_set.frequencies)}", f"steps={_join(steps)}"]
            words += [f"exposures_us={_join(exposures)}"] if exposures else []
        case "sequence":
            each = [p.exposure_us for p in patterns if p.exposure_us is not None]
            words = ["sequence", f"f={_join([p.frequency for p in patterns])}"]
            words += [f"shifts={_join([p.shift_rad for p in patterns])}"]
            words += [f"exposures_us={_join(each)}"] if each else []
    words += [f"axis={first.axis}"] if first.axis != "columns" else []
    words += [f"wave={first.wave}"] if first.wave != "sine" else []
    words += [f"gamma={_text(first.gamma)}"] if first.gamma != 1.0 else []
    return " ".join(words)


def _floats(text: str, values: dict[str, str], key: str, default: tuple[float, ...] | None = None) -> tuple[float, ...]:
    if key not in values:
        if default is None:
            raise ValueError(f"pattern set {text!r} has no {key}=")
        return default
    try:
        numbers = tuple(float(number) for number in values[key].split("/"))
    except ValueError as error:
        raise ValueError(f"pattern set {text!r}: {key}={values[key]} is not a list of numbers like 50/49/43") from error
    if not all(math.isfinite(number) for number in numbers):
        raise ValueError(f"pattern set {text!r}: {key} must be finite")
    return numbers


def _text(number: float) -> str:
    return repr(int(number)) if float(number).is_integer() and abs(number) < 1e15 else repr(float(number))


def _join(numbers: tuple[float, ...] | list[float] | list[int]) -> str:
    return "/".join(_text(number) for number in numbers)
