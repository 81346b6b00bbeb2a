"""How the hot loops are compiled: the one place that says so."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])

FASTMATH = {"contract", "reassoc", "arcp", "nsz"}
"""Without ``nnan`` and ``ninf``: invalid pixels are NaN, and tests for them must survive."""


def kernel(function: F) -> F:
    """Compile a loop for the machine: no GIL, cached on disk, vectorisable sums, NaN kept."""
    return cast(F, numba.njit(nogil=True, cache=True, fastmath=FASTMATH, error_model="numpy")(function))


def exact(function: F) -> F:
    """The same in strict IEEE arithmetic: for geometry in float64."""
    return cast(F, numba.njit(nogil=True, cache=True, error_model="numpy")(function))
