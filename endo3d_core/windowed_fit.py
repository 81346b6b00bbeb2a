"""Beyond the band-pass: the projector coordinate from the samples of both frequencies in a small window.

The band-pass sees a whole fringe, so near edges and on small objects it is wrong by tens of micrometres. It
is good enough to start from: with its phase e0 as base, the normalised samples s_f of both frequencies f obey

    s_f = a cos(rho_f (phi + e0 + d)),   d = D + m u,   rho_f = f / f1,

in a window, u being the column relative to its centre. With b = a tan D this is linear in (a, b, m),

    s_f ~ a cos_f + (b + m u) (-rho_f sin_f),   cos_f, sin_f at rho_f (phi + e0),

for any D where rho_f is one, nearly so for f2 = f1 - 1. One least-squares solution per pixel, its sums
box-filtered over the image, therefore replaces the Gauss-Newton iterations, and its information is the point's
sigma. Where one cosine has no slope the other has, but for two narrow beat zones where the neighbours help out.

A slope down the window need not be solved for: the fringes run along it, so it hardly couples with D.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from endo3d_core.compiled import kernel
from endo3d_core.phase import atan, cos_sin, reciprocal

HALF_COLUMNS, HALF_ROWS = 2, 1
"""The window is 5 columns by 3 rows."""
GAIN_PRIOR = 0.1
"""Samples' worth of belief that the gain is the band-pass's modulation: only felt where nothing else tells."""
SLOPE_PRIOR = 0.2
"""The same for a zero slope of the correction, in samples one column away."""
DEGREES_OF_FREEDOM = 2 * 15 - 3


@kernel
def smooth_base(phase: NDArray[np.float32], quarter_px: int, base: NDArray[np.float32]) -> None:
    """One row of the band-pass's phase -> base: a comb (1 2 1)/4 a quarter fringe apart, which nulls its ripple.

    What leaks from the mirror frequency has half a fringe's period. Where the comb leaves the valid
    surface or crosses an edge, the phase itself is taken.
    """
    q, quarter, two, limit = quarter_px, np.float32(0.25), np.float32(2.0), np.float32(0.5)
    width = phase.size
    for x in range(q):
        base[x], base[width - 1 - x] = phase[x], phase[width - 1 - x]
    left, here, right, inner = phase[: width - 2 * q], phase[q : width - q], phase[2 * q :], base[q : width - q]
    for x in range(inner.size):
        e = here[x]
        bend = left[x] - two * e + right[x]
        inner[x] = e + quarter * bend if abs(bend) < limit else e


@kernel
def products(
    base: NDArray[np.float32],
    carrier: NDArray[np.float32],
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    rho: np.float32,
    sums: NDArray[np.float32],
) -> None:
    """One row's six products of the samples ``first`` of f1 and ``second`` of f2 -> sums (6, width).

    0 where the base is NaN or a sample is exactly 0, which stands for dark or saturated: it says nothing, and at
    the edge of the field it would pull.
    """
    P, N, A, R, Q, S = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]
    zero, one = np.float32(0.0), np.float32(1.0)
    for x in range(base.size):
        phi, s1, s2 = carrier[x] + base[x], first[x], second[x]
        valid = (phi == phi) & (s1 != zero) & (s2 != zero)
        phi = phi if valid else zero
        c1, n1 = cos_sin(phi)
        c2, n2 = cos_sin(rho * phi)
        used = one if valid else zero
        c1, c2, n1, n2 = used * c1, used * c2, -used * n1, -rho * used * n2
        s1, s2 = used * s1, used * s2
        P[x] = n1 * n1 + n2 * n2
        N[x] = n1 * c1 + n2 * c2
        A[x] = c1 * c1 + c2 * c2
        R[x] = n1 * s1 + n2 * s2
        Q[x] = c1 * s1 + c2 * s2
        S[x] = s1 * s1 + s2 * s2


@kernel
def add_rows(a: NDArray[np.float32], b: NDArray[np.float32], c: NDArray[np.float32], out: NDArray[np.float32]) -> None:
    """(6, width) each -> out, padded by two columns on both sides."""
    for i in range(a.shape[0]):
        p, q, r, row = a[i], b[i], c[i], out[i, 2 : out.shape[1] - 2]
        for x in range(row.size):
            row[x] = p[x] + q[x] + r[x]


@kernel
def solve(
    sums: NDArray[np.float32],
    base: NDArray[np.float32],
    modulation: NDArray[np.float32],
    grey: NDArray[np.float32],
    slope: np.float32,
    offset: np.float32,
    modulation_min: np.float32,
    phase: NDArray[np.float32],
    variance: NDArray[np.float32],
    quality: NDArray[np.float32],
) -> None:
    """One row: window sums -> phase, its variance, quality.

    The misfit is what the model leaves of s^2, per degree of freedom: where it is more than the noise
    explains (an edge, moving texture), it takes the noise's place in the variance and lowers the quality.

    Nothing is divided before the end: unknowns carry the determinant as a factor, and one reciprocal of
    everything serves all three results. Divisions and roots would cost more than all the rest.
    """
    P, N, A, R, Q, S = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]
    two, four, one, nan = np.float32(2.0), np.float32(4.0), np.float32(1.0), np.float32(np.nan)
    gain_prior, slope_prior, tiny = np.float32(GAIN_PRIOR), np.float32(SLOPE_PRIOR), np.float32(1e-3)
    share, least = np.float32(1.0 / DEGREES_OF_FREEDOM), modulation_min * modulation_min
    for x in range(base.size):
        p1, p2 = P[x + 3] + P[x + 1], P[x + 4] + P[x]
        m0 = P[x + 2] + p1 + p2 + tiny
        m1 = (P[x + 3] - P[x + 1]) + two * (P[x + 4] - P[x])
        m2 = p1 + four * p2 + slope_prior
        k0 = N[x + 2] + N[x + 3] + N[x + 1] + N[x + 4] + N[x]
        k1 = (N[x + 3] - N[x + 1]) + two * (N[x + 4] - N[x])
        r0 = R[x + 2] + R[x + 3] + R[x + 1] + R[x + 4] + R[x]
        r1 = (R[x + 3] - R[x + 1]) + two * (R[x + 4] - R[x])
        a0 = A[x + 2] + A[x + 3] + A[x + 1] + A[x + 4] + A[x] + gain_prior
        believed = gain_prior * modulation[x]
        q0 = Q[x + 2] + Q[x + 3] + Q[x + 1] + Q[x + 4] + Q[x] + believed
        total = S[x + 2] + S[x + 3] + S[x + 1] + S[x + 4] + S[x] + believed * modulation[x]
        # Eliminate the slope (times m2), then solve the 2 x 2 that is left for (b, a), times its determinant.
        m, k, c = m0 * m2 - m1 * m1, k0 * m2 - m1 * k1, a0 * m2 - k1 * k1
        r, q = r0 * m2 - m1 * r1, q0 * m2 - k1 * r1
        det = m * c - k * k
        b, a = c * r - k * q, m * q - k * r
        power = a * a + b * b
        g, start = max(grey[x], one), base[x]
        g2 = g * g
        expected = (slope * g + offset) * det
        noise = max(expected, share * g2 * (total * det - b * r0 - a * q0))
        inverse = reciprocal(noise * g2 * power * a)
        t = b * inverse * noise * g2 * power
        good = (power > least * det * det) & (abs(t) < one) & (a > np.float32(0.0))
        d = atan(t)
        phase[x] = start + d if good else nan
        variance[x] = noise * noise * c * m2 * a * inverse
        quality[x] = expected * g2 * power * a * inverse
