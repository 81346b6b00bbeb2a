"""A package of stand-in services: real topics, no work."""

from __future__ import annotations

from pathlib import Path

import pytest

CAMERA = """
from endo3d.schemas import topics
from endo3d.services.runtime.service import Config, Source

class CameraConfig(Config):
    rate_hz: float = 30.0
    folder: "Path | None" = None
    head: str = ""
    rig: str = ""
    stack_toml: str = ""

from pathlib import Path
CameraConfig.model_rebuild()

class Camera(Source[CameraConfig]):
    Config = CameraConfig
    writes = (topics.FRAME, topics.MODE)
"""
DECODER = """
from typing import Literal
from endo3d.schemas import topics
from endo3d.services.runtime.service import Config, Service

class DecoderConfig(Config):
    mode: Literal["reuse", "three-frame"] = "reuse"
    bins: int = 4

class Decoder(Service[DecoderConfig]):
    Config = DecoderConfig
    reads = (topics.FRAME, topics.MODE)
    writes = (topics.CLOUD,)
"""
WATCHER = """
from endo3d.schemas import topics
from endo3d.services.runtime.service import Config, Service

class Watcher(Service[Config]):
    reads = optional = (topics.FRAME, topics.CLOUD, topics.POSE, topics.STATUS)
"""


@pytest.fixture
def standins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The package ``standins`` with camera, decoder and watcher, importable; its folder's parent."""
    package = tmp_path / "standins"
    package.mkdir()
    for name, source in {"__init__": "", "camera": CAMERA, "decoder": DECODER, "watcher": WATCHER}.items():
        (package / f"{name}.py").write_text(source)
    (package / "two.py").write_text(DECODER + "\nclass Other(Service[Config]): ...\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in ("camera", "decoder", "watcher", "two"):
        monkeypatch.delitem(__import__("sys").modules, f"standins.{name}", raising=False)
    monkeypatch.delitem(__import__("sys").modules, "standins", raising=False)
    return tmp_path
