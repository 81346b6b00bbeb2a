"""``make faults``: break everything in turn while a scan runs, and write down what happens.

    python -m bench.reliability.faults                      # all, about ten minutes
    python -m bench.reliability.faults kill stop            # those whose name begins so
    python -m bench.reliability.faults --page docs/reliability.md

After each fault: no hang, no pose that is wrong and does not say so, a named state, the time to recovery.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from bench.reliability import page
from bench.reliability.damage import Verdict, damage
from bench.reliability.hostile import Attacker
from bench.reliability.room import SHM, Room
from bench.reliability.scan import Hung, Scan
from endo3d.services.runtime.launcher import State

SERVICES = ("sequencer", "grabber", "decoder", "odometry", "recorder", "viewer")
WORLDLY = ("odometry",)
"""Whose process holds the map: a new one begins a new world."""
CAMERA, PROJECTOR = "camera", "projector"
TELLING = ("killed by", "restarted", "refused")
"""Lines that name what happened."""
STEADY_LIMIT_S, RECOVERY_LIMIT_S = 120.0, 120.0
STOPPED_S, STALLED_S, FULL_S = 4.0, 4.0, 6.0
DISK_MB, SHM_MB, FLOOR_MB = 3000, 1500, 512
MALFORMED, COMMANDS, DAMAGED_LOGS = 2000, 200, 30


@dataclass(frozen=True)
class Fault:
    """Something that goes wrong, and how it is put right again."""

    name: str
    inject: Callable[[Scan], object]
    lift: Callable[[Scan], object] = lambda scan: None
    hold_s: float = 0.0
    new_world: bool = False
    """The odometry begins a new map."""


@dataclass
class Outcome:
    """What a fault did."""

    fault: str
    recovery_s: float = float("nan")
    """From the moment it was over until every service was well and clouds and poses of later frames came."""
    state: str = ""
    """What said so, first."""
    tracking: dict[str, int] = field(default_factory=dict)
    lost: dict[str, int] = field(default_factory=dict)
    wrong_poses: int = 0
    worst_um: float = 0.0
    wrong_states: dict[str, int] = field(default_factory=dict)
    """What the wrong ones call themselves."""
    hung: str = ""

    @property
    def passed(self) -> bool:
        return not self.hung and not self.wrong_poses and bool(self.state)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("faults", nargs="*", help="names, or how they begin; default: all")
    parser.add_argument("--page", type=Path, help="write the table into this Markdown page")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="endo3d-faults-") as folder:
        room = Room(Path(folder), DISK_MB, SHM_MB)
        cables = Path(tempfile.mkdtemp(dir=folder))
        faults = [f for f in every_fault(room, cables) if not asked.faults or f.name.startswith(tuple(asked.faults))]
        if not faults:
            print(f"no such fault; there are: {', '.join(f.name for f in every_fault(room, cables))}", file=sys.stderr)
            return 2
        try:
            outcomes, log = campaign(room, cables, faults)
            whole_log = not asked.faults or "corrupted log".startswith(tuple(asked.faults))
            with tempfile.TemporaryDirectory(prefix="endo3d-damaged-") as elsewhere:  # the other one is small
                verdict = damage(log, Path(elsewhere), DAMAGED_LOGS) if whole_log else None
        finally:
            room.close()
    show(outcomes, verdict, room.reason)
    if asked.page:
        about_logs = asdict(verdict) if verdict is not None else None
        page.write_faults(asked.page, [asdict(outcome) for outcome in outcomes], about_logs, room.reason)
    failed = [outcome for outcome in outcomes if not outcome.passed]
    return int(bool(failed) or (verdict is not None and bool(verdict.misread or verdict.tracebacks)))


def every_fault(room: Room, cables: Path) -> list[Fault]:
    """In the order they are tried; full file systems only where they can be made without harm to others."""
    faults = [Fault(f"kill -9 {name}", partial(_kill, service=name), new_world=name in WORLDLY) for name in SERVICES]
    for name in SERVICES:
        stop, go_on = (partial(_signal, service=name, number=number) for number in (signal.SIGSTOP, signal.SIGCONT))
        faults.append(Fault(f"stop {name} for {STOPPED_S:g} s", stop, go_on, STOPPED_S))
    for name in SERVICES:
        faults.append(Fault(f"restart {name}", partial(_restart, service=name), new_world=name in WORLDLY))
    for fault, device in (("unplugged projector", PROJECTOR), ("stalled camera", CAMERA)):
        pull, plug = (partial(do, cable=cables / device) for do in (_pull, _plug))
        faults.append(Fault(fault, pull, plug, STALLED_S))
    if not room.reason:
        faults.append(Fault("full disk", partial(_fill_disk, room=room), partial(_free_disk, room=room), FULL_S))
        faults.append(
            Fault("full /dev/shm, new decoder", partial(_fill_shm, room=room), partial(_free_shm, room=room), FULL_S)
        )
    faults += [
        Fault("malformed messages", _malformed),
        Fault("foreign messages", _foreign),
        Fault("nonsense commands", _commands),
    ]
    return faults


def campaign(room: Room, cables: Path, faults: Sequence[Fault]) -> tuple[list[Outcome], Path]:
    """Suffer every fault in turn in one scan; the outcomes, and the first log."""
    for device in (CAMERA, PROJECTOR):
        (cables / device).touch()
    overrides = [
        f"rig.name=faults{os.getpid()}",
        f"sequencer.projector=dlpc900:emulated?cable={cables / PROJECTOR}",
        "sequencer.rate_hz=15",
        "grabber.camera=sim:contour texture=noise:0.15:0.15?motion=hand seed=7&preset=fast&bin=2&slow_motion=11.5"
        f"&cable={cables / CAMERA}",
        f"recorder.directory={room.disk / 'logs'}",
        "recorder.name=scan",
        "recorder.log_hz={frame = 2}",
        f"recorder.floor_mb={FLOOR_MB}",
        "viewer.port=0",
        "viewer.web_port=0",
    ]
    outcomes = []
    with Progress(console=Console(stderr=True), transient=True) as progress, Scan("demo", overrides) as scan:
        task = progress.add_task("", total=len(faults))
        for fault in faults:
            progress.update(task, description=fault.name)
            outcomes.append(suffer(scan, fault))
            progress.console.print(f"{fault.name:<42} {_in_words(outcomes[-1])}")
            progress.advance(task)
    return outcomes, room.disk / "logs" / "scan.mcap"


def suffer(scan: Scan, fault: Fault) -> Outcome:
    """One fault, from a scan that goes well to one that goes well again."""
    outcome = Outcome(fault.name)
    try:
        scan.until(_well_from_now(scan), STEADY_LIMIT_S, "the scan before the fault")
        scan.listen()
        lost_before = scan.witness.lost()
        fault.inject(scan)
        if fault.new_world:
            scan.witness.forget_worlds()
        scan.turn_for(fault.hold_s)
        fault.lift(scan)
        outcome.recovery_s = scan.until(_well_from_now(scan), RECOVERY_LIMIT_S, "recovery")
        scan.turn_for(1.5)  # the next status of everybody
        outcome.lost = dict(sorted((scan.witness.lost() - lost_before).items()))
    except Hung as hung:
        outcome.hung = str(hung)
    seen = scan.witness.take()
    outcome.tracking, outcome.wrong_states = dict(seen.tracking), dict(seen.wrong_states)
    outcome.wrong_poses, outcome.worst_um = seen.wrong, 1e3 * seen.worst_mm
    launcher_said = next((line for line in scan.said if any(word in line for word in TELLING)), "")
    note = next((f"{name}: {note}" for name, note in seen.notes.items()), "")
    gone = f"{seen.gone[0]}: gone from the bus" if seen.gone else ""
    outcome.state = launcher_said or note or gone or ("counted" if outcome.lost else "")
    return outcome


def _well_from_now(scan: Scan) -> Callable[[], bool]:
    now_ns = scan.now_ns()
    return lambda: scan.witness.all_well_after(now_ns, scan.services) and all(
        child.state is State.RUNNING for child in scan.launcher.children
    )


def _kill(scan: Scan, service: str) -> None:
    _signal(scan, service, signal.SIGKILL)
    victim = scan.child(service).pid
    scan.until(lambda: scan.child(service).pid not in (None, victim), RECOVERY_LIMIT_S, f"a new {service}")


def _signal(scan: Scan, service: str, number: signal.Signals) -> None:
    pid = scan.child(service).pid
    assert pid is not None
    os.kill(pid, number)


def _restart(scan: Scan, service: str) -> None:
    old = scan.child(service).pid
    scan.launcher.restart(service)
    scan.until(lambda: scan.child(service).pid not in (None, old), RECOVERY_LIMIT_S, f"a new {service}")


def _pull(scan: Scan, cable: Path) -> None:
    cable.unlink()


def _plug(scan: Scan, cable: Path) -> None:
    cable.touch()


def _fill_disk(scan: Scan, room: Room) -> None:
    room.fill(room.disk, FLOOR_MB // 2)


def _free_disk(scan: Scan, room: Room) -> None:
    """Make room again and ask for a new recording."""
    room.clear(room.disk)
    scan.bus.call("recorder", "start", timeout_s=30.0)


def _fill_shm(scan: Scan, room: Room) -> None:
    room.fill(SHM, 1)
    _kill(scan, "decoder")


def _free_shm(scan: Scan, room: Room) -> None:
    room.clear(SHM)


def _malformed(scan: Scan) -> None:
    with Attacker(scan.rig) as attacker:
        scan.turn_for(3.0)  # it listens first
        sent = attacker.malformed(MALFORMED)
    scan.said.append(f"stranger: {sum(sent.values())} malformed messages on {len(sent)} keys")


def _foreign(scan: Scan) -> None:
    with Attacker(scan.rig) as attacker:
        scan.turn_for(3.0)
        attacker.foreign()


def _commands(scan: Scan) -> None:
    with Attacker(scan.rig) as attacker:
        sent, refused = attacker.commands(scan.services, COMMANDS)
    scan.said.append(f"{refused} of {sent} commands refused with a reason")


def _in_words(outcome: Outcome) -> str:
    if outcome.hung:
        return f"[red]HUNG[/red] {outcome.hung}"
    words = f"recovered after {outcome.recovery_s:.1f} s"
    if outcome.wrong_poses:
        words += f", [red]{outcome.wrong_poses} wrong poses[/red]: up to {outcome.worst_um:.0f} um"
        words += f", {', '.join(outcome.wrong_states)}"
    return words


def show(outcomes: Sequence[Outcome], verdict: Verdict | None, reason: str) -> None:
    table = Table(title="simulated scan; faults in turn")
    for column in ("fault", "recovery s", "what said so", "lost", "wrong poses"):
        table.add_column(column)
    for outcome in outcomes:
        total = Counter(outcome.lost).total()
        recovery = "hung" if outcome.hung else f"{outcome.recovery_s:.1f}"
        table.add_row(outcome.fault, recovery, outcome.state or "nothing", str(total), str(outcome.wrong_poses))
    Console().print(table)
    if reason:
        print(f"left out: full disk, full /dev/shm ({reason})")
    if verdict is not None:
        print(
            f"{verdict.logs} damaged logs: {verdict.refused} refused in one line, {verdict.repaired} repaired "
            f"({verdict.messages} messages, {verdict.misread} wrong), {verdict.beyond_repair} beyond repair, "
            f"{verdict.tracebacks} tracebacks"
        )


if __name__ == "__main__":
    sys.exit(main())
