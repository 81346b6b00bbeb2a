"""Results of single measurements on disk, so that an interrupted evaluation goes on where it stopped."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from functools import cache as once
from importlib.resources import files
from pathlib import Path
from typing import Any

Result = dict[str, Any] | None


MEASURING = ("endo3d_core", "endo3d_core.virtual_rig", "endo3d.services", "endo3d.services.evaluation")
"""The packages whose code decides what is measured."""


@once
def program(*packages: str) -> str:
    """A fingerprint of code: results of other code don't count."""
    digest = hashlib.sha256()
    for package in packages:
        for path in sorted(Path(str(files(package))).glob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


class Cache:
    """One JSON file of results by name."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._results: dict[str, Result] = {}
        if path.exists():
            kept = json.loads(path.read_text(encoding="utf-8"))
            if kept.get("program") == program(*MEASURING):
                self._results = kept["results"]

    def get(self, name: str, work: Callable[[], Result]) -> Result:
        """The result of that name; done now, and kept, when it isn't there."""
        if name not in self._results:
            self._results[name] = work()
            self._path.parent.mkdir(parents=True, exist_ok=True)
            fresh = self._path.with_suffix(".new")
            fresh.write_text(json.dumps({"program": program(*MEASURING), "results": self._results}), encoding="utf-8")
            os.replace(fresh, self._path)
        return self._results[name]
