"""Two hosts over a real router: what one writes the other reads, and who may do what."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scans
from one_machine import Alive, Host, Repeating, Seen, hosts_of, rig_of, stack_of

from endo3d.schemas import topics
from endo3d.schemas.messages import Frame, MapDelta, Mode, Status
from endo3d.services.relay import Relay
from endo3d.services.runtime.bus import Bus
from endo3d.services.runtime.service import Refused
from endo3d.services.views.merged import MergedMap

VIEWED = (topics.FRAME, topics.CLOUD, topics.POSE, topics.MAP, topics.MODE)


def publish(bus: Bus, *wanted: type, frames: int = 6) -> None:
    for message in scans.messages(frames):
        if isinstance(message, wanted):
            bus.publish(message)


def say_until_known(writer: Bus, seen: Seen) -> None:
    """Until the last of the topics gets through: then the way of all of them is known."""
    mode = next(message for message in scans.messages(1) if isinstance(message, Mode))
    with Repeating(lambda: writer.publish(mode)):
        seen.wait(lambda came: bool(came[topics.MODE]))


def answering(host: Host, service: str) -> list[tuple[str, Mapping[str, Any]]]:
    """A service on that host that takes every command but ``no``; what it was told."""
    told: list[tuple[str, Mapping[str, Any]]] = []

    def answer(verb: str, parameters: Mapping[str, Any]) -> Mapping[str, Any]:
        told.append((verb, parameters))
        if verb == "no":
            raise Refused("not now; try later")
        return {"done": parameters.get("what", "")}

    bus = host.open(service)
    bus.serve(answer)
    bus.declare_alive()
    return told


def test_the_far_host_reads_what_the_rig_writes(tmp_path: Path) -> None:
    with hosts_of(stack_of(rig_of("full")), tmp_path / "keys") as hosts:
        seen = Seen(hosts["workstation"].open("reader"), *VIEWED)
        writer = hosts["rig"].open("scanner")
        sent = [message for message in scans.messages(8) if topics.of(message) in VIEWED]
        say_until_known(writer, seen)
        first = next(message for message in sent if isinstance(message, Frame))
        with Repeating(lambda: writer.publish(first)):
            seen.wait(lambda came: bool(came[topics.FRAME]))
        for message in sent:
            writer.publish(message)
        seen.wait(lambda came: len(came[topics.POSE]) == 8 and len(came[topics.MAP]) == 8 and bool(came[topics.CLOUD]))
        assert [pose.sequence for pose in seen.messages[topics.POSE]] == list(range(8))
        assert [delta.revision for delta in seen.messages[topics.MAP]] == list(range(8))
        assert np.array_equal(seen.messages[topics.FRAME][0].image, first.image)
        cloud = seen.messages[topics.CLOUD][0]
        assert cloud.points.tobytes() == scans.points_of(cloud.sequence).tobytes()


def test_who_comes_late_gets_what_is_latched(tmp_path: Path) -> None:
    with hosts_of(stack_of(rig_of("late")), tmp_path / "keys") as hosts:
        publish(hosts["rig"].open("scanner"), Mode)
        seen = Seen(hosts["workstation"].open("reader"), topics.MODE)
        seen.wait(lambda came: bool(came[topics.MODE]))
        assert seen.messages[topics.MODE][0].pattern_set == "interleaved f1=25"


def test_a_thin_link_carries_pictures_and_the_whole_map(tmp_path: Path) -> None:
    keys = "preview = {image_hz = 100.0, image_step = 2, cloud_hz = 100.0, cloud_step = 2, map_hz = 4.0}"
    with hosts_of(stack_of(rig_of("thin"), keys=keys), tmp_path / "keys") as hosts:
        seen = Seen(hosts["workstation"].open("reader"), topics.FRAME, topics.CLOUD, topics.MAP, topics.MODE)
        writer = hosts["rig"].open("scanner")
        rows = scans.map_of(scans.points_of(0))
        smooth = np.add.outer(np.arange(300) % 200, np.arange(480) % 40).astype(np.uint8)
        expected = MergedMap()
        deltas = [message for message in scans.messages(12) if isinstance(message, MapDelta)]
        say_until_known(writer, seen)
        for delta in [*deltas, replace(deltas[-1], points=deltas[-1].points[:1], removed=_keys(rows[:5]), revision=12)]:
            writer.publish(delta)
            expected.add(delta)
        whole = expected.points()
        assert whole is not None

        def gathered(deltas: list[MapDelta]) -> MergedMap:
            merged = MergedMap()
            for delta in deltas:
                merged.add(delta)
            return merged

        def arrived(came: dict[Any, list[Any]]) -> bool:
            points = gathered(came[topics.MAP]).points() if came[topics.MAP] else None
            return points is not None and len(points) == len(whole)

        seen.wait(arrived)
        points = gathered(seen.messages[topics.MAP]).points()
        assert points is not None
        assert np.sort(points, order=["kx", "ky", "kz"]).tobytes() == np.sort(whole, order=["kx", "ky", "kz"]).tobytes()
        revisions = [delta.revision for delta in seen.messages[topics.MAP]]
        assert revisions == list(range(1, len(revisions) + 1)), "a gap would mean that something is missing"
        frame = next(message for message in scans.messages(1) if isinstance(message, Frame))
        with Repeating(lambda: writer.publish(replace(frame, image=smooth))):
            seen.wait(lambda came: bool(came[topics.FRAME]))
        picture = seen.messages[topics.FRAME][0].image
        assert picture.shape == (150, 240)
        assert np.abs(picture.astype(int) - smooth[::2, ::2]).mean() < 6
        publish(writer, type(next(m for m in scans.messages(1) if topics.of(m) == topics.CLOUD)))
        seen.wait(lambda came: bool(came[topics.CLOUD]))
        cloud = seen.messages[topics.CLOUD][0]
        assert cloud.points.tobytes() == np.ascontiguousarray(scans.points_of(cloud.sequence)[::2, ::2]).tobytes()
        assert cloud.grid_px == 20.0


def _keys(points: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    return np.stack([points[name] for name in ("kx", "ky", "kz")], axis=-1).astype(np.int16)


def test_an_operator_commands_from_afar(tmp_path: Path) -> None:
    with hosts_of(stack_of(rig_of("operator")), tmp_path / "keys") as hosts:
        told = answering(hosts["rig"], "odometry")
        cli = hosts["workstation"].open("cli")
        Alive(cli).wait(lambda there: "odometry" in there)
        assert cli.call("odometry", "reset", {"what": "map"}, 30.0) == {"done": "map"}
        assert ("reset", {"what": "map"}) in told
        with pytest.raises(Refused, match="not now; try later"):
            cli.call("odometry", "no", {}, 30.0)


def test_a_viewer_sees_and_may_not_command(tmp_path: Path) -> None:
    with hosts_of(stack_of(rig_of("viewer"), role="viewer"), tmp_path / "keys") as hosts:
        told = answering(hosts["rig"], "odometry")
        cli = hosts["workstation"].open("cli")
        Alive(cli).wait(lambda there: "odometry" in there)
        with pytest.raises(Refused, match="may look, not command"):
            cli.call("odometry", "reset", {}, 30.0)
        assert not [verb for verb, _ in told if verb == "reset"]
        publish(hosts["rig"].open("scanner"), Mode)
        Seen(cli, topics.MODE).wait(lambda came: bool(came[topics.MODE]))


def test_every_host_sees_how_all_services_do(tmp_path: Path) -> None:
    with hosts_of(stack_of(rig_of("status")), tmp_path / "keys") as hosts:
        on_rig, on_workstation = (Seen(hosts[name].open("top"), topics.STATUS, topics.LOG) for name in hosts)
        status, line = (m for m in scans.messages(1) if topics.of(m) in (topics.STATUS, topics.LOG))
        decoder, viewer = hosts["rig"].open("decoder"), hosts["workstation"].open("viewer")
        with Repeating(lambda: (decoder.publish(status), decoder.publish(line))):
            on_workstation.wait(lambda came: any(s.service == "decoder" for s in came[topics.STATUS]))
            on_workstation.wait(lambda came: any(m.message == "frame 0" for m in came[topics.LOG]))
        with Repeating(lambda: viewer.publish(replace(status, service="viewer"))):
            on_rig.wait(lambda came: any(s.service == "viewer" for s in came[topics.STATUS]))
        viewer.publish(replace(status, service="odometry"))  # not this host's to say: stays here
        viewer.publish(replace(status, service="viewer", pid=2))
        on_rig.wait(lambda came: any(s.service == "viewer" and s.pid == 2 for s in came[topics.STATUS]))
        assert not [s for s in on_rig.messages[topics.STATUS] if s.service == "odometry"]


class ThreeSecondsSlow(Relay):
    """The relay of a host whose clock is behind."""

    @staticmethod
    def clock() -> int:
        return time.time_ns() - 3_000_000_000


def test_a_clock_that_is_off_is_measured_and_stamps_are_the_rigs(tmp_path: Path) -> None:
    with hosts_of(stack_of(rig_of("clock")), tmp_path / "keys", workstation=ThreeSecondsSlow) as hosts:
        end = time.monotonic() + 150
        while "clock_offset_ms" not in (values := hosts["workstation"].relay.values()):
            assert time.monotonic() < end
            time.sleep(0.05)
        assert abs(values["clock_offset_ms"] - 3_000) <= values["round_trip_ms"] / 2 + 1
        seen = Seen(hosts["rig"].open("top"), topics.STATUS)
        status = next(m for m in scans.messages(1) if isinstance(m, Status))
        said_ns, viewer = time.time_ns(), hosts["workstation"].open("viewer")
        with Repeating(lambda: viewer.publish(replace(status, service="viewer", stamp_ns=said_ns - 3_000_000_000))):
            seen.wait(lambda came: any(s.service == "viewer" for s in came[topics.STATUS]))
        stamp_ns = next(s.stamp_ns for s in seen.messages[topics.STATUS] if s.service == "viewer")
        assert abs(stamp_ns - said_ns) <= 1e6 * (values["round_trip_ms"] + 1)


def test_who_goes_is_seen_to_go(tmp_path: Path) -> None:
    with hosts_of(stack_of(rig_of("gone")), tmp_path / "keys") as hosts:
        decoder = hosts["rig"].open("decoder")
        decoder.declare_alive()
        alive = Alive(hosts["workstation"].open("top"))
        alive.wait(lambda there: "decoder" in there)
        decoder.close()
        alive.wait(lambda there: "decoder" not in there)
