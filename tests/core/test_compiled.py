"""Compiled loops: the same bits in the process that compiles them and in those that load them from the cache."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from endo3d_core.compiled import kernel


@kernel
def _long_row(row: NDArray[np.float32], out: NDArray[np.float32]) -> None:
    """Long enough that LLVM would rather call it than copy it to every place of use."""
    for x in range(row.size):
        t = row[x]
        for _ in range(7):
            t = np.sin(t) * np.cos(t) + row[x] * np.sqrt(abs(t)) - np.float32(0.25) * np.arctan2(t, row[x])
        out[x] = t / (np.float32(1.0) + abs(t)) + np.exp(-t * t) - np.log(np.float32(2.0) + abs(t))


@kernel
def _three_rows(rows: NDArray[np.float32], out: NDArray[np.float32]) -> None:
    _long_row(rows[0], out[0])
    _long_row(rows[1], out[1])
    _long_row(rows[2], out[2])


def test_no_kernel_calls_another() -> None:
    """A call would reach whichever of two machine codes was loaded first, and they differ in the last bits."""
    rows = np.linspace(0.1, 2.0, 60, dtype=np.float32).reshape(3, 20)
    out = np.zeros_like(rows)
    _three_rows(rows, out)
    assert np.isfinite(out).all()
    _three_rows.recompile()  # type: ignore[attr-defined]  # what comes from the cache can't be looked into
    (signature,) = _three_rows.signatures  # type: ignore[attr-defined]
    code: str = _three_rows.inspect_asm(signature)  # type: ignore[attr-defined]
    reached = [line for line in code.splitlines() if "_long_row" in line and ("call" in line or "movabs" in line)]
    assert reached == []
