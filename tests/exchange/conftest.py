"""A log file of the made-up scan."""

from __future__ import annotations

from pathlib import Path

import pytest
from scans import write_log


@pytest.fixture(scope="session")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four frames and all that goes with them."""
    path = tmp_path_factory.mktemp("logs") / "scan.mcap"
    write_log(path)
    return path
