"""How the hot loops are compiled: the one place that says so.

Loops stay vectorised if every array element is read before a conditional expression chooses
(``v = a[x]; out[x] = v if good else zero``: a load inside the choice makes the loop scalar, five times slower),
if rows of one scratch array never alias within a loop, if constants are float32, and if no root or quotient is
used on one side of a choice only (LLVM sinks it into a branch).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import Any, TypeVar, cast

import llvmlite.binding as llvm

if "numba" not in sys.modules and "NUMBA_CPU_FEATURES" not in os.environ:
    # LLVM prefers 256-bit code on Intel's AVX-512 cores, for the sake of old ones; these loops gain up to
    # half from the full width. Read once at numba's import, so it has to be said before. Nothing is forced that
    # the CPU doesn't report: this only takes back a preference.
    _features = llvm.get_host_cpu_features()
    if _features.get("avx512f"):
        os.environ["NUMBA_CPU_NAME"] = llvm.get_host_cpu_name()
        os.environ["NUMBA_CPU_FEATURES"] = _features.flatten() + ",-prefer-256-bit"

import numba

F = TypeVar("F", bound=Callable[..., Any])

FASTMATH = {"contract", "reassoc", "arcp", "nsz"}
"""Without ``nnan`` and ``ninf``: invalid pixels are NaN, and tests for them must survive."""

INLINED: dict[str, Any] = {"forceinline": True}
"""Into kernels that call them. A kernel that stays a call exists twice under one name, in its own object and,
optimised once more, in its caller's; which of both runs would depend on what is loaded first: the process that
compiles and those that load from the cache would differ in the last bits."""


def kernel(function: F) -> F:
    """Compile a loop for the machine: no GIL, cached on disk, vectorisable sums, NaN kept."""
    return cast(F, numba.njit(nogil=True, cache=True, fastmath=FASTMATH, error_model="numpy", **INLINED)(function))


def exact(function: F) -> F:
    """The same in strict IEEE arithmetic: for geometry in float64."""
    return cast(F, numba.njit(nogil=True, cache=True, error_model="numpy", **INLINED)(function))
