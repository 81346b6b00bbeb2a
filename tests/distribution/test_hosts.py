"""What a stack file says about hosts: which service runs where, what crosses, and what is said about a wrong one."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from one_machine import SERVICES, stack_of

from endo3d.services.runtime import graph, hosts, stack_file
from endo3d.services.runtime.errors import UserError
from endo3d.services.runtime.launcher import children_of
from endo3d.services.runtime.network import nested, router_settings
from endo3d.services.runtime.replay import live_stack

TWO = '[hosts.left]\nrole = "rig"\n[hosts.right]\nrole = "rig"\n'
SHARED = 'host = ["left", "right"]'


def crossing(stack: stack_file.Stack) -> dict[tuple[str, str], list[str]]:
    """(from, to) -> topics, without what every host tells every other."""
    lanes = hosts.lanes(stack.placement, graph.of(stack))
    named = {(lane.sender, lane.receiver): [t.name for t in lane.topics if not t.per_service] for lane in lanes}
    return {way: names for way, names in named.items() if names}


def test_a_host_runs_its_share_and_a_relay() -> None:
    stack = stack_of("bench")
    assert list(stack.on("rig").share()) == ["scanner", "decoder", "odometry", "relay", "router"]
    assert stack.on("workstation").share() == {"viewer": "viewer", "relay": "relay-workstation"}


def test_what_is_read_elsewhere_crosses_and_nothing_else() -> None:
    assert crossing(stack_of("bench")) == {("rig", "workstation"): ["frame", "cloud", "pose", "map", "mode"]}


def test_streams_asks_for_more() -> None:
    laptop = '[hosts.laptop]\nstreams = ["depth"]\n'
    assert crossing(stack_of("bench", hosts=laptop))["rig", "laptop"] == ["depth"]


def test_a_shared_decoder_has_a_name_on_each_host() -> None:
    stack = stack_of("bench", hosts=TWO, decoder=SHARED)
    assert stack.on("left").share() == {"decoder": "decoder-left", "relay": "relay-left"}
    assert crossing(stack) == {
        ("rig", "left"): ["frame"],
        ("rig", "right"): ["frame"],
        ("left", "rig"): ["cloud"],
        ("right", "rig"): ["cloud"],
        ("rig", "workstation"): ["frame", "pose", "map", "mode"],
        ("left", "workstation"): ["cloud"],
        ("right", "workstation"): ["cloud"],
    }


def test_the_launcher_starts_this_hosts_share(tmp_path: Path) -> None:
    file = tmp_path / "stack.toml"
    file.write_text(stack_of("bench", hosts=TWO, decoder=SHARED).toml)
    children = children_of(stack_file.load(file).on("left"), ["rig.port=4000"])
    assert [child.name for child in children] == ["decoder-left", "relay-left"]
    options = ["--stack", str(file), "--set", "rig.port=4000", "--host", "left"]
    assert list(children[0].command[-7:]) == ["decoder", *options]


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('host = "workstation"', 'host = "elsewhere"', "[viewer] runs on 'elsewhere', but the hosts are rig, work"),
        ('role = "rig"', 'role = "operator"', "[hosts.rig] runs the router and has to be trusted"),
        ('role = "rig"', 'role = "king"', "hosts.rig.role = 'king' is wrong"),
        ('address = "127.0.0.1"', "", "no host has an address"),
        ("[hosts.workstation]", '[hosts."work station"]', "'work station' is no host's name"),
        ("[hosts.workstation]", "[hosts.workstation]\nadress = 3", "has no key 'adress'; the nearest is 'address'"),
        ('module = "acting.scanner"', 'module = "acting.scanner"\nhost = "workstation"', 'it needs role = "rig"'),
        ('module = "acting.odometry"', 'module = "acting.odometry"\nhost = ["rig", "workstation"]', "can't be shared"),
        ("[hosts.workstation]", '[hosts.workstation]\nstreams = ["pos"]', "no topic 'pos'"),
    ],
)
def test_wrong_hosts_are_named_in_one_line(old: str, new: str, says: str) -> None:
    text = stack_of("bench").toml
    assert old in text
    with pytest.raises(UserError) as error:
        graph.of(stack_file.loads(text.replace(old, new)))
    assert says in str(error.value)
    assert "\n" not in str(error.value)


def test_hosts_need_to_be_told_apart() -> None:
    with pytest.raises(UserError, match="several hosts: say which one this is, --host NAME; known: rig, workstation"):
        stack_of("bench").on("")
    with pytest.raises(UserError, match="no host 'rgi'; the nearest is 'rig'"):
        stack_of("bench").on("rgi")
    with pytest.raises(UserError, match="names a host, but there is no"):
        stack_file.loads("[rig]\n" + SERVICES.format(decoder=""))


def test_an_override_reaches_a_host() -> None:
    text = stack_of("bench").toml
    assert stack_file.loads(text, ["hosts.rig.port=7777"]).placement.endpoint == "tls/127.0.0.1:7777"


def test_a_log_of_several_hosts_is_replayed_on_one(tmp_path: Path) -> None:
    stack = stack_of("bench", hosts=TWO, decoder=SHARED)
    live = stack_file.loads(live_stack(stack, tmp_path / "a.mcap", rate=1, loop=False, start_s=0, end_s=0, out=None))
    assert list(live.tables) == ["player", "decoder", "odometry", "viewer"]
    assert live.share() == {name: name for name in live.tables}


def test_up_says_what_is_missing() -> None:
    """Nothing is started: no host named; then no certificates."""
    up = [sys.executable, "-m", "endo3d.services.cli.app", "up", "rig_workstation"]
    said = subprocess.run(up, capture_output=True, text=True, check=False)
    assert said.returncode == 2
    assert "several hosts" in said.stderr


def test_the_routers_file_for_zenohd_is_what_ours_runs_with() -> None:
    """deploy/zenoh holds what ``endo3d check STACK --zenohd`` writes."""
    stack = stack_file.load("rig_workstation")
    file = stack_file.stock("stacks")["rig_workstation"].parents[1] / "zenoh" / "rig_workstation.json5"
    check = [sys.executable, "-m", "endo3d.services.cli.app", "check", "rig_workstation", "--zenohd"]
    said = subprocess.run(check, capture_output=True, text=True, check=True).stdout
    assert file.read_text() == said
    body = json.loads("\n".join(line for line in said.splitlines() if not line.startswith("//")))
    from endo3d.services.runtime.identity import Identity

    folder = Path("/etc/endo3d/keys")
    identity = Identity(folder / "ca.pem", folder / "rig.pem", folder / "rig.key")
    assert body == nested(router_settings(stack.rig.name, stack.placement, identity))
