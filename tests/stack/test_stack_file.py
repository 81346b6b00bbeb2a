"""The stack file: what it says, and what is said about a wrong one."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from endo3d.services.runtime import graph, stack_file
from endo3d.services.runtime.errors import UserError

STACK = """
[rig]
name = "bench"
head = "base6_wd10"

[camera]
module = "standins.camera"
rate_hz = 25.0
folder = "images"

[decoder]
module = "standins.decoder"

[watcher]
module = "standins.watcher"
"""


@pytest.fixture
def stack_path(standins: Path) -> Path:
    path = standins / "stack.toml"
    path.write_text(STACK)
    return path


def complaint(path: Path, text: str, overrides: tuple[str, ...] = ()) -> str:
    path.write_text(text)
    with pytest.raises(UserError) as error:
        graph.of(stack_file.load(path, overrides))
    return str(error.value)


def test_entries_in_flow_order_with_shared_values_and_paths(stack_path: Path) -> None:
    camera, decoder, watcher = stack_file.load(stack_path).entries
    assert [entry.name for entry in (camera, decoder, watcher)] == ["camera", "decoder", "watcher"]
    assert camera.is_source
    assert not decoder.is_source
    assert camera.config.model_dump() == {
        "rate_hz": 25.0,
        "folder": stack_path.parent / "images",
        "head": str(stack_file.stock("heads")["base6_wd10"]),
        "rig": "bench",
        "stack_toml": STACK,
    }
    assert type(decoder.build()).__name__ == "Decoder"


def test_paths_of_a_stock_stack_start_where_you_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By its name or, as in the processes of the launcher, by its path."""
    monkeypatch.chdir(tmp_path)
    for source in ("demo", stack_file.stock("stacks")["demo"]):
        assert stack_file.load(source).entry("recorder").config.model_dump()["directory"] == tmp_path / "out"


def test_override_reaches_the_config_and_the_text(stack_path: Path) -> None:
    stack = stack_file.load(stack_path, ("decoder.mode=three-frame", "decoder.bins=2", "rig.name=other"))
    assert stack.entry("decoder").config.model_dump() == {"mode": "three-frame", "bins": 2}
    assert stack.rig.name == "other"
    again = stack_file.loads(stack.toml, base=stack.base)
    assert again.tables == stack.tables
    assert again.rig == stack.rig


def test_two_instances_of_one_module(stack_path: Path) -> None:
    stack_path.write_text(STACK.replace("[decoder]", "[left]"))
    assert [entry.module for entry in stack_file.load(stack_path).entries] == ["camera", "decoder", "watcher"]


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (
            "rate_hz = 25.0",
            "rat_hz = 25.0",
            "stack.toml:8: [camera] has no key 'rat_hz'; the nearest is 'rate_hz'",
        ),
        ("rate_hz = 25.0", 'rate_hz = "fast"', "stack.toml:8: camera.rate_hz = 'fast' is wrong"),
        ('name = "bench"', 'nam = "bench"', "stack.toml:3: [rig] has no key 'nam'; the nearest is 'name'"),
        ('name = "bench"', 'name = "a/b"', "stack.toml:3: rig.name = 'a/b' is wrong"),
        ("base6_wd10", "base6_wd1", "no head 'base6_wd1' here; the nearest is 'base6_wd10'"),
        (
            '[camera]\nmodule = "standins.camera"',
            "[recoder]",
            "no service module 'recoder'; the nearest is 'recorder'",
        ),
        ("standins.decoder", "standins.two", "holds 2 services, not one"),
        ("[rig]", "[rig", "is not valid TOML"),
        ("[rig]", "speed = 3\n[rig]", "stack.toml:2: 'speed' stands outside of a table"),
        (
            '\n[camera]\nmodule = "standins.camera"\nrate_hz = 25.0\nfolder = "images"\n',
            "",
            "decoder reads 'frame', which nobody in this stack writes",
        ),
        (
            "[watcher]",
            '[right]\nmodule = "standins.decoder"\n[watcher]',
            "decoder and right both write 'cloud'",
        ),
    ],
)
def test_a_wrong_stack_is_named_in_one_line(stack_path: Path, old: str, new: str, says: str) -> None:
    assert old in STACK
    message = complaint(stack_path, STACK.replace(old, new))
    assert says in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("decoder.mod=reuse", "[decoder] has no key 'mod'; the nearest is 'mode'"),
        ("decodr.mode=reuse", "the stack has no table [decodr]; the nearest is 'decoder'"),
        ("decoder.mode", "not table.key=value"),
        ("decoder.mode=fast", "decoder.mode = 'fast' is wrong"),
    ],
)
def test_a_wrong_override_is_named(stack_path: Path, override: str, says: str) -> None:
    assert says in complaint(stack_path, STACK, (override,))


def test_a_missing_file_and_a_missing_stock_stack(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"no stack '.*gone.toml' here; check the path"):
        stack_file.load(tmp_path / "gone.toml")
    with pytest.raises(UserError, match="no stack 'nope' here; known: "):
        stack_file.load("nope")


def test_a_reader_that_needs_no_writer(stack_path: Path) -> None:
    """The watcher also reads poses, which nobody writes here, and statuses, which every service writes."""
    wiring = graph.of(stack_file.load(stack_path))
    assert {(edge.topic.name, edge.writer, edge.reader) for edge in wiring.edges} == {
        ("frame", "camera", "decoder"),
        ("mode", "camera", "decoder"),
        ("frame", "camera", "watcher"),
        ("cloud", "decoder", "watcher"),
    }


def test_the_graph_in_other_languages(stack_path: Path) -> None:
    wiring = graph.of(stack_file.load(stack_path))
    assert "camera -->|frame<br>mode| decoder" in wiring.mermaid()
    assert '"camera" -> "decoder" [label="frame mode"];' in wiring.dot()
    assert wiring.as_dict()["edges"][0] == {"key": "endo3d/bench/frame", "from": "camera", "to": "decoder"}


@pytest.mark.parametrize("name", stack_file.stock("stacks"))
def test_every_stock_stack_is_right(name: str) -> None:
    assert graph.of(stack_file.load(name)).entries


names = st.text("abz_", min_size=1, max_size=3)
values = st.recursive(
    st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(names, inner, max_size=3),
    max_leaves=5,
)


@given(st.dictionaries(names, st.dictionaries(names, values, max_size=3), max_size=3))
def test_written_toml_reads_back(tables: dict[str, dict[str, object]]) -> None:
    assert tomllib.loads(stack_file.to_toml(tables)) == tables
