"""Phase arithmetic for hot loops: float32, branch-free, so that the compiler uses the whole SIMD width."""

from __future__ import annotations

import numpy as np

from endo3d_core.compiled import kernel

PI = np.float32(np.pi)
HALF_PI = np.float32(np.pi / 2)
TWO_PI = np.float32(2 * np.pi)
PER_TURN = np.float32(1 / (2 * np.pi))
HALF = np.float32(0.5)
ZERO = np.float32(0.0)
ONE = np.float32(1.0)
TINY = np.float32(1e-30)

# Minimax odd polynomial of atan on [0, 1] (Abramowitz and Stegun 4.4.47 in form): error 1.1e-5 rad.
_A1 = np.float32(0.9998660)
_A3 = np.float32(-0.3302995)
_A5 = np.float32(0.1801410)
_A7 = np.float32(-0.0851330)
_A9 = np.float32(0.0208351)


_RECIPROCAL, _ROOT = np.int32(0x7EF311C7), np.int32(0x5F3759DF)
_THREE_HALVES = np.float32(1.5)


@kernel
def reciprocal(x: np.float32) -> np.float32:
    """1 / x of a normal x > 0 to 2e-7: half the time of a division, which a wide vector unit can't pipeline.

    The exponent's bits negate themselves; two steps of Halley's method turn their 12 % into 0.2 % and rounding.
    """
    y = np.int32(_RECIPROCAL - np.float32(x).view(np.int32)).view(np.float32)
    e = ONE - x * y
    y += y * (e + e * e)
    e = ONE - x * y
    return y + y * (e + e * e)


@kernel
def root(x: np.float32) -> np.float32:
    """Square root of x >= 0 to 5e-6, from the inverse root of the same kind and two steps of Newton's method."""
    y = np.int32(_ROOT - (np.float32(max(x, TINY)).view(np.int32) >> np.int32(1))).view(np.float32)
    half = HALF * x
    y = y * (_THREE_HALVES - half * y * y)
    y = y * (_THREE_HALVES - half * y * y)
    return x * y


@kernel
def atan(t: np.float32) -> np.float32:
    """Of -1 <= t <= 1, to 1.2e-5 rad."""
    t2 = t * t
    return t * (_A1 + t2 * (_A3 + t2 * (_A5 + t2 * (_A7 + t2 * _A9))))


@kernel
def angle(y: np.float32, x: np.float32) -> np.float32:
    """atan2(y, x) to 1.2e-5 rad; 0 at the origin, NaN stays NaN."""
    ax, ay = abs(x), abs(y)
    swap = ay > ax
    t = (ax if swap else ay) * reciprocal((ay if swap else ax) + TINY)
    a = atan(t)
    a = HALF_PI - a if swap else a
    a = PI - a if x < ZERO else a
    return -a if y < ZERO else a


@kernel
def wrap(phase: np.float32) -> np.float32:
    """Into -pi .. pi."""
    turns: np.float32 = np.floor(phase * PER_TURN + HALF)
    return phase - TWO_PI * turns


# Taylor to x^9 and x^10 on -pi/2 .. pi/2 after folding; error 4e-6, far below a grey value's worth of phase.
_S3, _S5, _S7, _S9 = (np.float32(c) for c in (-1 / 6, 1 / 120, -1 / 5040, 1 / 362880))
_C2, _C4, _C6, _C8, _C10 = (np.float32(c) for c in (-1 / 2, 1 / 24, -1 / 720, 1 / 40320, -1 / 3628800))


@kernel
def cos_sin(phase: np.float32) -> tuple[np.float32, np.float32]:
    """(cos, sin) of any phase of moderate size (|phase| < 1e4), to 4e-6."""
    half_turns = np.floor(phase * (PER_TURN + PER_TURN) + HALF)
    x = phase - half_turns * PI
    odd = half_turns - (np.floor(half_turns * HALF)) * np.float32(2.0)
    sign = ONE - (odd + odd)
    x2 = x * x
    s = x * (ONE + x2 * (_S3 + x2 * (_S5 + x2 * (_S7 + x2 * _S9))))
    c = ONE + x2 * (_C2 + x2 * (_C4 + x2 * (_C6 + x2 * (_C8 + x2 * _C10))))
    return sign * c, sign * s
