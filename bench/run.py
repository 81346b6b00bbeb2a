"""``make bench``: every benchmark in turn, under the machine's name.

    python -m bench.run                 # all
    python -m bench.run decode stack    # some

A benchmark is a module beside this one that prints its table when it is run, and ends with an exit code
other than 0 when it could not measure. Missing a goal is a figure in the table, not a failure.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import time
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import psutil

TIMEOUT_S = 900.0


def machine() -> str:
    """This machine in one line."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")
    cores = len(os.sched_getaffinity(0))
    memory_gb = psutil.virtual_memory().total / 2**30
    system = f"{platform.system()} {platform.release()}"
    return f"{platform.node()}: {model or platform.machine()}, {cores} cores, {memory_gb:.0f} GB, {system}"


def benchmarks() -> list[str]:
    """The names of all benchmarks."""
    here = Path(__file__).parent
    return sorted(path.stem for path in here.glob("*.py") if path.stem not in ("__init__", "run", "common"))


def main(wanted: list[str]) -> int:
    """Run the benchmarks, all if none is named; the number of those that failed."""
    known = benchmarks()
    unknown = [name for name in wanted if name not in known]
    if unknown:
        print(f"no benchmark {unknown[0]!r}; there are: {', '.join(known)}", file=sys.stderr)
        return 2
    print(f"endo3d {version('endo3d')}, Python {platform.python_version()}")
    print(machine())
    print(f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC, load {os.getloadavg()[0]:.1f}\n", flush=True)
    failed = []
    for name in wanted or known:
        print(f"== {name}", flush=True)
        began_s = time.monotonic()
        try:
            code = subprocess.run([sys.executable, "-m", f"bench.{name}"], timeout=TIMEOUT_S).returncode
        except subprocess.TimeoutExpired:
            code = -1
        print(f"   ({time.monotonic() - began_s:.0f} s)\n", flush=True)
        if code:
            failed.append(name)
    if failed:
        print(f"could not measure: {', '.join(failed)}", file=sys.stderr)
    return len(failed)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
