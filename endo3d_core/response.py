"""The light-to-grey response, measured from fringe images themselves, and its removal.

A projector that shows h(p) where p = 1/2 + 1/2 cos(phi + s) was meant bends every n-step phase: a third
harmonic of phi with three steps. Over many fringes all phases are equally frequent, so the wanted light p
follows the arcsine law, F(p) = arccos(1 - 2 p) / pi, and the measured grey values' own cumulative
distribution F gives back the light that was meant (H. Guo, H. He, M. Chen: Gamma correction for digital
fringe projection profilometry, Appl. Opt. 43, 2004):

    u(n) = 1/2 - 1/2 cos(pi F(n)).

Evenly spaced shifts are pooled: they cancel whatever is uneven in the phases but for every n-th harmonic.
The check is independent of that assumption: n samples of one pixel obey sum u = n / 2 and
sum (u - 1/2)^2 = n / 8 whatever the phase.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

NODES = 513
"""Of the distribution; it is linear between them."""
PIXELS_MIN = 1000


@dataclass(frozen=True, eq=False)
class Response:
    """Normalised grey (0 black, 1 white) -> relative light that was meant."""

    grey: NDArray[np.float64]
    """(NODES,) ascending."""
    light: NDArray[np.float64]
    """(NODES,) 0..1, the light meant at each."""
    residual: float
    """Root mean square violation of the two sums, per sample, with the response removed."""
    residual_before: float
    """The same of the samples as they are."""

    def linear(self, grey: NDArray[np.floating]) -> NDArray[np.float32]:
        """Normalised grey values of any shape -> what would have been measured without the response."""
        return np.asarray(np.interp(grey, self.grey, self.light), np.float32)

    @property
    def gamma(self) -> float:
        """The power law nearest to the response: grey = light^gamma; what ``gamma=`` of a pattern set undoes."""
        middle = (self.light > 0.1) & (self.light < 0.9) & (self.grey > 0)
        light, grey = np.log(self.light[middle]), np.log(self.grey[middle])
        return float(np.sum(grey * light) / np.sum(light**2))


def normalised(
    frames: NDArray[np.generic], white: NDArray[np.generic], black: NDArray[np.generic], contrast_min: float = 8.0
) -> NDArray[np.float32]:
    """frames (n, height, width), white and black (height, width) -> (n, height, width) of 0..1.

    NaN where white is less than ``contrast_min`` grey values over black.
    """
    dark = black.astype(np.float32)
    span = white.astype(np.float32) - dark
    span = np.where(span >= contrast_min, span, np.nan)
    return np.asarray((frames.astype(np.float32) - dark) / span, np.float32)


def measure(samples: NDArray[np.floating]) -> Response:
    """samples (n, ...) normalised, of n >= 3 evenly spaced shifts over many fringes, NaN ignored -> the response.

    Raises ``ValueError`` when the samples are too few or do not cover the range from dark to bright.
    """
    n = samples.shape[0]
    if n < 3:
        raise ValueError(f"{n} shifts don't show a response; three evenly spaced ones are needed")
    pixels = samples.reshape(n, -1).astype(np.float64)
    pixels = pixels[:, np.all(np.isfinite(pixels), axis=0)]
    if pixels.shape[1] < PIXELS_MIN or np.ptp(np.percentile(pixels, (5, 95))) < 0.5:
        raise ValueError("too few pixels go from dark to bright; show the fringes on a brighter surface")
    share = (np.arange(NODES) + 0.5) / NODES
    grey = np.maximum.accumulate(np.quantile(pixels, share) + 1e-9 * np.arange(NODES))
    light = 0.5 - 0.5 * np.cos(np.pi * share)
    linear = np.interp(pixels, grey, light)
    return Response(grey, light, _violation(linear), _violation(pixels))


def _violation(u: NDArray[np.float64]) -> float:
    """By how much (n, pixels) light misses the two sums, per sample."""
    mean = u.mean(axis=0) - 1 / 2
    power = ((u - 0.5) ** 2).mean(axis=0) - 1 / 8
    return float(np.sqrt(np.mean(mean**2 + power**2)))
