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
    t = (ax if swap else ay) / ((ay if swap else ax) + TINY)
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
