"""What a flat reference shows of a calibration's remaining bend: a small correction of 1/z over the volume.

delta(1/z) = sum c_ijk x^i y^j (q / q0 - 1)^k with 2 <= i + j <= 4 and k = 0, 1, over the ray's slopes (x, y) and q =
1/z. Planes stay out of it by construction: their 1/z is linear in (x, y), so a flat surface can't show the terms
below second order.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml
from numpy.typing import ArrayLike, NDArray

SECTION = "flat_reference"
POWERS = tuple((i, n - i, k) for k in (0, 1) for n in (2, 3, 4) for i in range(n + 1))
"""(i, j, k) of each coefficient."""


@dataclass(frozen=True, eq=False)
class Bow:
    """No coefficients: no correction."""

    inverse_depth: float = 1.0
    """q0, 1/mm: the middle of the volume."""
    coefficients: tuple[float, ...] = ()
    """Of ``POWERS``, 1/mm."""

    def __call__(self, x: ArrayLike, y: ArrayLike, q: ArrayLike) -> NDArray[np.float64]:
        """What is added to 1/z (1/mm) at slopes (x, y) and q = 1/z; the arguments broadcast."""
        shape = np.broadcast_shapes(np.shape(x), np.shape(y), np.shape(q))
        if not self.coefficients:
            return np.zeros(shape)
        return np.asarray(terms(x, y, q, self.inverse_depth) @ np.array(self.coefficients))

    @classmethod
    def from_tree(cls, section: Any) -> Bow:
        """The section of a calibration file. Raises ``ValueError`` when it is not one."""
        if section is None:
            return NO_BOW
        try:
            bow = cls(float(section["inverse_depth"]), tuple(float(c) for c in section["coefficients"]))
        except (TypeError, KeyError, ValueError) as error:
            raise ValueError(f"the calibration's {SECTION} needs inverse_depth and coefficients") from error
        if len(bow.coefficients) not in (0, len(POWERS)) or not bow.inverse_depth > 0:
            raise ValueError(f"the calibration's {SECTION} needs {len(POWERS)} coefficients and inverse_depth > 0")
        return bow

    @classmethod
    def from_yaml(cls, text: str) -> Bow:
        """Of a whole calibration file."""
        tree = yaml.safe_load(text) if text else None
        return cls.from_tree(tree.get(SECTION) if isinstance(tree, Mapping) else None)


NO_BOW = Bow()


def terms(x: ArrayLike, y: ArrayLike, q: ArrayLike, inverse_depth: float) -> NDArray[np.float64]:
    """(..., len(POWERS)) values of the polynomial's terms."""
    x, y, d = np.broadcast_arrays(np.asarray(x, np.float64), y, np.asarray(q, np.float64) / inverse_depth - 1.0)
    return np.stack([x**i * y**j * d**k for i, j, k in POWERS], axis=-1)
