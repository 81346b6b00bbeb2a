"""``endo3d devices``, and the device URIs that a stack file names."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from endo3d.services.cli.app import app
from endo3d.services.devices import camera, projector
from endo3d.services.devices.uri import DeviceError, Setting


def test_every_driver_is_listed_with_what_to_do() -> None:
    result = CliRunner().invoke(app, ["devices", "--json"])
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    listed = {(each["role"], each["uri"].partition(":")[0]) for each in found}
    assert {scheme for role, scheme in listed if role == "projector"} == set(projector.DRIVERS)
    assert {scheme for role, scheme in listed if role == "camera"} == set(camera.DRIVERS) - {"log"}
    for each in found:
        assert each["state"] == "ready" or each["todo"], each


@pytest.mark.parametrize("scheme", ["dlpc900", "dlpc350", "alp", "screen"])
def test_a_projector_that_is_not_there_says_what_to_do(
    scheme: str, setting: Setting, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(DeviceError, match=r"plug|install|DISPLAY"):
        projector.open_projector(f"{scheme}:", setting)


@pytest.mark.parametrize("scheme", ["uvc:97", "gentl:", "gentl:none.cti", "folder:none"])
def test_a_camera_that_is_not_there_says_what_to_do(
    scheme: str, setting: Setting, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("GENICAM_GENTL64_PATH", raising=False)
    with pytest.raises(DeviceError, match=r"endo3d devices|install|folder:"):
        camera.open_camera(scheme, setting)


@pytest.mark.parametrize("text", ["dlpc9000:", "nothing", ":x"])
def test_an_unknown_driver_is_named(text: str, setting: Setting) -> None:
    with pytest.raises(DeviceError, match=r"there are|no scheme"):
        projector.open_projector(text, setting)
