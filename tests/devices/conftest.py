from __future__ import annotations

from importlib import resources

import pytest
from plugged import Plugged

from endo3d.services.devices.uri import Setting


@pytest.fixture(scope="session")
def setting() -> Setting:
    head = resources.files("endo3d.deploy") / "heads" / "base6_wd20.yaml"
    return Setting("tests-devices", head.read_text(encoding="utf-8"))


@pytest.fixture
def plugged() -> Plugged:
    return Plugged()
