"""What a log says about where it was made."""

from __future__ import annotations

import platform
import sys
from collections.abc import Mapping
from importlib.metadata import version

import psutil

VERSION = version("endo3d")
LIBRARY = f"endo3d {VERSION}"
_PACKAGES = ("eclipse-zenoh", "mcap", "numba", "numpy", "protobuf")


def host_facts() -> Mapping[str, str]:
    """Software versions and the machine, for a log's metadata; nothing about the person."""
    return {
        "endo3d": VERSION,
        "python": sys.version.split()[0],
        "platform": platform.platform(),
        "machine": platform.machine(),
        "processor": _processor(),
        "cores": str(psutil.cpu_count(logical=True)),
        "memory_mb": str(psutil.virtual_memory().total >> 20),
        "host": platform.node(),
    } | {package: version(package) for package in _PACKAGES}


def _processor() -> str:
    """The CPU's name: Linux tells it only here."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:
            return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()
