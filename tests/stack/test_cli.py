"""The command line: quick to help, and one clear line for what a user got wrong."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from endo3d.services.cli.app import LazyGroup, app
from endo3d.services.runtime import stack_file
from endo3d.services.runtime.errors import UserError
from endo3d.services.runtime.session import meeting_ports

LIMIT_S = 180
COMMANDS = list(LazyGroup().commands)
READ_LOGS = [name for name in ("replay", "view", "export") if name in COMMANDS]


def endo3d(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run the command line as a user would."""
    return subprocess.run(
        [sys.executable, "-m", "endo3d.services.cli.app", *arguments],
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        env={**os.environ, "COLUMNS": "120", **environment},
    )


def complaint(*arguments: str, **environment: str) -> str:
    """The one line of a command that ends with exit code 2."""
    ended = endo3d(*arguments, **environment)
    assert ended.returncode == 2, ended.stderr
    lines = ended.stderr.strip().splitlines()
    assert lines[-1].startswith("endo3d: ")
    assert "Traceback" not in ended.stderr
    return lines[-1]


def test_help_names_every_command_and_imports_none() -> None:
    script = (
        "import sys\n"
        "from endo3d.services.cli.app import main\n"
        "sys.argv = ['endo3d', '--help']\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "print(sorted({'numpy', 'numba', 'zenoh', 'rerun', 'scipy', 'pydantic'} & set(sys.modules)))\n"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=LIMIT_S)
    assert all(f" {name} " in ended.stdout for name in COMMANDS), ended.stdout
    assert ended.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_explains_itself(name: str) -> None:
    shown = CliRunner().invoke(app, [name, "--help"])
    assert shown.exit_code == 0
    assert "Usage:" in shown.stdout


def test_a_mistyped_command_gets_the_nearest() -> None:
    ended = endo3d("chek")
    assert ended.returncode == 2
    assert "'check'" in ended.stderr


def test_check_prints_the_graph_in_every_language() -> None:
    def check(*arguments: str) -> str:
        ended = CliRunner().invoke(app, ["check", "demo", *arguments])
        assert ended.exit_code == 0
        return ended.stdout

    assert "frame (Frame, up to 180 Hz, shared memory) → decoder" in check()
    assert {"key": "endo3d/demo/cloud", "from": "decoder", "to": "odometry"} in json.loads(check("--json"))["edges"]
    assert check("--mermaid").startswith("flowchart LR\n    sequencer -->|mode| grabber")
    assert check("--keys", "odometry").count("merging_distance_um") == 1


def test_the_shell_can_complete() -> None:
    script = Path(sys.executable).with_name("endo3d")
    asked = {"_ENDO3D_COMPLETE": "complete_bash", "COMP_WORDS": "endo3d check dem", "COMP_CWORD": "2"}
    ended = subprocess.run([script], capture_output=True, text=True, timeout=LIMIT_S, env={**os.environ, **asked})
    assert ended.stdout.split() == ["demo"]


class TestBadInput:
    """Issue by issue: what is wrong, what to do, exit code 2, no traceback."""

    def test_wrong_key(self) -> None:
        line = complaint("check", "demo", "--set", "decoder.bin_pxx=2")
        assert "[decoder] has no key 'bin_pxx'; the nearest is 'bin_px'" in line

    def test_wrong_value_reaches_the_launcher_before_anything_starts(self) -> None:
        assert "decoder.bin_px = 3 is wrong" in complaint("up", "demo", "--set", "decoder.bin_px=3")

    @pytest.mark.parametrize("command", ["check", "up"])
    def test_missing_stack(self, command: str) -> None:
        assert "no stack 'gone.toml' here; check the path" in complaint(command, "gone.toml")

    @pytest.mark.parametrize("command", [*READ_LOGS, "recover"])
    def test_missing_log(self, command: str, tmp_path: Path) -> None:
        assert "gone.mcap" in complaint(command, str(tmp_path / "gone.mcap"), *_required(command, tmp_path))

    @pytest.mark.parametrize("command", READ_LOGS)
    def test_unreadable_log(self, command: str, tmp_path: Path) -> None:
        log = tmp_path / "torn.mcap"
        log.write_bytes(b"\x89MCAP0\r\n" + bytes(1000))
        assert "torn.mcap" in complaint(command, str(log), *_required(command, tmp_path))

    def test_missing_log_of_a_player(self, tmp_path: Path) -> None:
        stack = tmp_path / "play.toml"
        stack.write_text('[player]\nlog = "gone.mcap"\n')
        assert f"can't read {tmp_path}/gone.mcap" in complaint("run", "player", "--stack", str(stack))

    def test_a_service_that_cannot_start_ends_the_stack(self, tmp_path: Path) -> None:
        stack = tmp_path / "play.toml"
        stack.write_text(f'[rig]\nname = "play{os.getpid()}"\n[player]\nlog = "gone.mcap"\n[decoder]\n')
        assert complaint("up", str(stack)).startswith(f"endo3d: player: can't read {tmp_path}/gone.mcap")

    def test_unknown_topic(self) -> None:
        assert "no topic 'clouds'; there are: frame, cloud" in complaint("tap", "clouds")

    def test_nobody_there(self) -> None:
        assert "no service of rig nowhere is there" in complaint("top", "--once", "--rig", "nowhere")

    def test_busy_ports(self, taken_ports: str) -> None:
        """All meeting ports of a rig belong to foreign programs."""
        line = complaint("run", "sequencer", "--set", f"rig.name={taken_ports}")
        assert str(meeting_ports(taken_ports)[0]) in line

    def test_busy_port_of_the_viewer(self, tmp_path: Path) -> None:
        with socket.create_server(("127.0.0.1", 0)) as server:
            port = server.getsockname()[1]
            line = complaint(
                "run",
                "viewer",
                "--set",
                "viewer.show=web",
                "--set",
                f"viewer.port={port}",
                "--set",
                "rig.name=busy",
            )
        assert f"port {port} is busy" in line

    def test_missing_package(self, tmp_path: Path) -> None:
        """A package that can't be imported is named, whatever wanted it."""
        (tmp_path / "wanting.py").write_text("import a_package_that_is_not_there\n")
        stack = tmp_path / "stack.toml"
        stack.write_text('[own]\nmodule = "package.wanting"\n')
        (tmp_path / "package").mkdir()
        (tmp_path / "wanting.py").rename(tmp_path / "package" / "wanting.py")
        line = complaint("check", str(stack), PYTHONPATH=str(tmp_path))
        assert "needs the package 'a_package_that_is_not_there'; pip install it" in line


def _required(command: str, folder: Path) -> list[str]:
    return {"view": ["--picture", str(folder / "x.png")], "export": [str(folder / "x.ply")]}.get(command, [])


@pytest.fixture
def taken_ports() -> Iterator[str]:
    """The name of a rig whose meeting ports are taken by somebody who doesn't speak zenoh."""
    rig = f"taken{os.getpid()}"
    servers = [socket.create_server(("127.0.0.1", port)) for port in meeting_ports(rig)]
    yield rig
    for server in servers:
        server.close()


def test_a_service_that_refuses_its_values_names_its_table() -> None:
    with pytest.raises(UserError, match=r"recorder.log_hz = .*no topic clouds"):
        stack_file.load("demo", ("recorder.log_hz={clouds = 1.0}",)).entry("recorder").build()


def test_doctor_reports_and_ends_with_its_verdict(tmp_path: Path) -> None:
    ended = endo3d("doctor", "--json", "--directory", str(tmp_path))
    findings = {finding["name"]: finding for finding in json.loads(ended.stdout)}
    assert {"locked memory", "/dev/shm", "processor", "projector", "display", "packages", "disk"} <= set(findings)
    assert all(finding["todo"] for finding in findings.values() if finding["level"] != "ok")
    assert ended.returncode == int(any(finding["level"] == "fatal" for finding in findings.values()))


def test_doctor_finds_a_folder_that_cannot_be_recorded_to(tmp_path: Path) -> None:
    ended = endo3d("doctor", "--json", "--directory", str(tmp_path / "gone"))
    disk = next(finding for finding in json.loads(ended.stdout) if finding["name"] == "disk")
    assert (disk["level"], ended.returncode) == ("fatal", 1)


def test_doctor_without_a_display_says_what_to_do() -> None:
    environment = dict.fromkeys(("DISPLAY", "WAYLAND_DISPLAY"), "")
    ended = endo3d("doctor", "--json", **environment)
    display = next(finding for finding in json.loads(ended.stdout) if finding["name"] == "display")
    assert display["level"] == "warn"
    assert "browser" in display["todo"]
