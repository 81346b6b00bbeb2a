"""What is installed is all there: run against the sources and, by .ci/run, against the built wheel."""

from __future__ import annotations

import importlib
import pkgutil
import tomllib
from importlib import metadata, resources
from pathlib import Path

import pytest

from endo3d.services.runtime import stack_file

ROOT = Path(__file__).parents[2]
FOLDERS = {"endo3d.schemas": "schemas", "endo3d.services": "services", "endo3d.deploy": "deploy"}
OPTIONAL = {"blosc2", "gi", "pye57", "pymeshlab"}
"""Packages of the extras: a module may need one to be imported."""


def packages_of(folder: Path, name: str) -> set[str]:
    inner = (path.parent.relative_to(folder) for path in folder.rglob("__init__.py"))
    return {".".join((name, *path.parts)) for path in inner}


def modules() -> list[str]:
    found = ["endo3d_core", *FOLDERS]
    for name in tuple(found):
        package = importlib.import_module(name)
        found += [module.name for module in pkgutil.walk_packages(package.__path__, f"{name}.")]
    return found


def test_every_package_is_listed() -> None:
    """A sub-package that isn't works in an editable installation, and is absent from the wheel."""
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    there = packages_of(ROOT / "endo3d_core", "endo3d_core").union(
        *(packages_of(ROOT / folder, name) for name, folder in FOLDERS.items())
    )
    assert set(listed) == there


@pytest.mark.parametrize("name", modules())
def test_every_module_can_be_imported(name: str) -> None:
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name not in OPTIONAL:
            raise


def test_data_files_are_installed() -> None:
    assert {"demo", "player"} <= set(stack_file.stock("stacks"))
    assert {"base6_wd20", "base6_wd10", "base35_wd10", "base35_wd20"} <= set(stack_file.stock("heads"))
    for package in ("endo3d.schemas", "endo3d.services", "endo3d_core"):
        assert (resources.files(package) / "py.typed").is_file()
    tested = (resources.files("endo3d.deploy") / "constraints.txt").read_text()
    assert "://" not in tested


def test_the_command_is_installed() -> None:
    (command,) = metadata.entry_points(group="console_scripts", name="endo3d")
    assert callable(command.load())
