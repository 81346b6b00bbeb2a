from __future__ import annotations

from collections.abc import Iterator
from importlib import resources

import pytest
from fake_gige import FakeGige, running
from plugged import Plugged

from endo3d.services.devices.aravis_camera import library
from endo3d.services.devices.uri import DeviceError, Setting


@pytest.fixture(scope="session")
def setting() -> Setting:
    head = resources.files("endo3d.deploy") / "heads" / "base6_wd20.yaml"
    return Setting("tests-devices", head.read_text(encoding="utf-8"))


@pytest.fixture
def plugged() -> Plugged:
    return Plugged()


@pytest.fixture
def fake_gige() -> Iterator[FakeGige]:
    try:
        library()
    except DeviceError as error:
        pytest.skip(str(error))
    with running() as gige:
        yield gige
