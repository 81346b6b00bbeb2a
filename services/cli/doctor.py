"""``endo3d doctor``: what on this machine helps or hinders, and what to do."""

from __future__ import annotations

import json
import os
import platform
import resource
import shutil
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from enum import StrEnum
from importlib import metadata, resources
from pathlib import Path
from typing import Annotated

import typer

from endo3d.services.cli.options import JsonOption

POOL_MB = 512
"""What a rig's shared memory takes at most: ``Bus.open``'s default."""
FRAME_BYTES_PER_S = 1920 * 1200 * 180
"""A camera at full rate."""
PROJECTORS = {("0451", "c900"): "DLPC900", ("0451", "6401"): "DLPC350"}
USBFS_MB = 1000
"""What a USB3 Vision camera at full rate needs (hardware.md, section 3)."""
DISK_SAMPLE_MB = 256


class Level(StrEnum):
    OK = "ok"
    WARN = "warn"
    FATAL = "fatal"


@dataclass(frozen=True)
class Finding:
    """One thing looked at: what was found, and what to do if that isn't good."""

    name: str
    level: Level
    found: str
    todo: str = ""


def doctor(
    directory: Annotated[Path, typer.Option("--directory", help="Where logs will be recorded.")] = Path(),
    as_json: JsonOption = False,
) -> None:
    """Check this machine, and say what to do.

    Ends with exit code 1 if something would keep the stack from running at all.
    """
    findings = list(examine(directory))
    if as_json:
        print(json.dumps([asdict(finding) for finding in findings], indent=2))
    else:
        _show(findings)
    raise typer.Exit(int(any(finding.level is Level.FATAL for finding in findings)))


def examine(directory: Path) -> Iterator[Finding]:
    """All findings, cheap ones first."""
    checks: tuple[Callable[[], Finding], ...] = (
        python_version,
        package_versions,
        processor,
        locked_memory,
        shared_memory,
        zero_copy,
        compiled_kernels,
        display,
        usb_access,
        usb_buffers,
        loopback,
        lambda: disk(directory),
    )
    for check in checks:
        yield check()


def python_version() -> Finding:
    found = f"{platform.python_implementation()} {platform.python_version()} on {platform.platform()}"
    if sys.platform != "linux":
        return Finding("python", Level.WARN, found, "endo3d is tested on Linux only")
    return Finding("python", Level.OK, found)


def package_versions() -> Finding:
    """What is installed against what was tested."""
    tested = dict(
        line.split("==")
        for line in (resources.files("endo3d.deploy") / "constraints.txt").read_text().splitlines()
        if "==" in line
    )
    required = [
        _requirement_name(text) for text in metadata.requires("endo3d") or [] if "extra ==" not in text
    ]
    missing, other = [], []
    for name in required:
        try:
            version = metadata.version(name)
        except metadata.PackageNotFoundError:
            missing.append(name)
            continue
        if tested.get(name, version) != version:
            other.append(f"{name} {version} (tested {tested[name]})")
    if missing:
        return Finding("packages", Level.FATAL, f"missing: {', '.join(missing)}", "pip install endo3d again")
    if other:
        return Finding(
            "packages", Level.WARN, ", ".join(other), "fine unless something fails; then use what was tested"
        )
    return Finding("packages", Level.OK, f"{len(required)} packages, all as tested")


def processor() -> Finding:
    """Cores and vector units; the decoder is compiled for what the processor reports."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    flags = set(_cpu_field("flags").split())
    vector = next((unit for unit in ("avx512f", "avx2", "asimd") if unit in flags), "no vector unit known")
    found = f"{_cpu_field('model name') or platform.machine()}, {cores} cores, {vector}"
    if cores < 2:
        return Finding(
            "processor", Level.WARN, found, "give the stack two cores; one holds the demo at a lower rate"
        )
    if vector == "no vector unit known" or (platform.machine() == "x86_64" and "avx2" not in flags):
        return Finding("processor", Level.WARN, found, "expect a lower rate: the kernels profit from AVX2")
    return Finding("processor", Level.OK, found)


def locked_memory() -> Finding:
    """Every process locks the shared-memory pool; the launcher raises the limit where it may."""
    soft, hard = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    may_raise = os.geteuid() == 0
    found = f"limit {_megabytes(soft)}, at most {_megabytes(hard)}" + (
        ", root may raise it" if may_raise else ""
    )
    if may_raise or hard == resource.RLIM_INFINITY or hard >= POOL_MB << 20:
        return Finding("locked memory", Level.OK, found)
    return Finding(
        "locked memory",
        Level.WARN,
        found,
        f"large messages will go over the loopback network; allow {POOL_MB} MB: `ulimit -l unlimited`, a line"
        " `* - memlock unlimited` in /etc/security/limits.conf, LimitMEMLOCK=infinity in a systemd unit, or"
        " --ulimit memlock=-1 for a container",
    )


def shared_memory() -> Finding:
    try:
        free = shutil.disk_usage("/dev/shm").free
    except OSError:
        return Finding(
            "/dev/shm", Level.FATAL, "not there", "mount it: mount -t tmpfs -o size=1g tmpfs /dev/shm"
        )
    if free < POOL_MB << 20:
        todo = "remount it larger: mount -o remount,size=1g /dev/shm; in a container: --shm-size=1g"
        return Finding("/dev/shm", Level.WARN, f"{_megabytes(free)} free", f"{POOL_MB} MB are wanted; {todo}")
    return Finding("/dev/shm", Level.OK, f"{_megabytes(free)} free")


def zero_copy() -> Finding:
    """The bus's own self-test."""
    import zenoh

    from endo3d.services.runtime import pool

    version = metadata.version("eclipse-zenoh")
    try:
        view = pool.self_test()
    except zenoh.ZError as error:
        return Finding(
            "zero copy", Level.WARN, str(error), "messages go over the loopback network; see locked memory"
        )
    if view is None:
        return Finding("zero copy", Level.WARN, f"no view in zenoh {version}", "install the zenoh tested")
    return Finding("zero copy", Level.OK, f"zenoh {version}, views verified")


def compiled_kernels() -> Finding:
    """Where numba keeps what it compiled: without it every start compiles for half a minute."""
    import endo3d_core

    folder = Path(os.environ.get("NUMBA_CACHE_DIR") or Path(endo3d_core.__path__[0]) / "__pycache__")
    where = folder if folder.exists() else folder.parent
    kept = sum(1 for _ in folder.rglob("*.nbc")) if folder.exists() else 0
    if os.access(where, os.W_OK):
        return Finding("compiled kernels", Level.OK, f"{kept} kept in {folder}")
    home = Path.home() / ".cache" / "numba"
    return Finding(
        "compiled kernels",
        Level.WARN,
        f"{folder} can't be written; {home} is used",
        f"make sure {home} is writable, or set NUMBA_CACHE_DIR",
    )


def display() -> Finding:
    shown_on = os.environ.get("WAYLAND_DISPLAY") or os.environ.get("DISPLAY")
    if shown_on:
        return Finding("display", Level.OK, shown_on)
    return Finding(
        "display",
        Level.WARN,
        "none",
        "the viewer serves a page for a browser instead; endo3d up says its address",
    )


def usb_access() -> Finding:
    """Projectors on the bus, and whether we may speak to them."""
    seen = list(_projectors())
    if not seen:
        return Finding("projector", Level.OK, "none on USB: the virtual rig is there (sim:)")
    closed = [f"{name} ({node})" for name, node in seen if not os.access(node, os.R_OK | os.W_OK)]
    if closed:
        rule = resources.files("endo3d.deploy") / "udev" / "70-endo3d.rules"
        todo = f"sudo cp {rule} /etc/udev/rules.d/, then plug it in again"
        return Finding("projector", Level.WARN, f"no permission for {', '.join(closed)}", todo)
    return Finding("projector", Level.OK, ", ".join(name for name, _ in seen))


def usb_buffers() -> Finding:
    limit = Path("/sys/module/usbcore/parameters/usbfs_memory_mb")
    try:
        megabytes = int(limit.read_text())
    except (OSError, ValueError):
        return Finding("USB buffers", Level.OK, "not known here; only a USB3 camera needs them")
    if 0 < megabytes < USBFS_MB:
        todo = f"for a USB3 camera: echo {USBFS_MB} > {limit}; at boot usbcore.usbfs_memory_mb={USBFS_MB}"
        return Finding("USB buffers", Level.WARN, f"{megabytes} MB", todo)
    return Finding("USB buffers", Level.OK, f"{megabytes} MB")


def loopback() -> Finding:
    """The services of a host meet on loopback ports."""
    try:
        with socket.create_server(("127.0.0.1", 0)) as server, socket.create_connection(server.getsockname()):
            return Finding("loopback", Level.OK, "127.0.0.1 answers")
    except OSError as error:
        return Finding("loopback", Level.FATAL, str(error), "bring it up: ip link set lo up")


def disk(directory: Path) -> Finding:
    """Space, and speed of plain writes as the recorder's."""
    try:
        free = shutil.disk_usage(directory).free
        speed = _write_speed(directory)
    except OSError as error:
        return Finding(
            "disk", Level.FATAL, f"{directory.resolve()}: {error}", "choose another --directory to record to"
        )
    minutes = free / FRAME_BYTES_PER_S / 60
    space = f"{free / 1e9:.0f} GB free, {minutes:.0f} min of frames"
    found = f"{directory.resolve()}: {space}, writes {speed / 1e6:.0f} MB/s"
    if speed < FRAME_BYTES_PER_S:
        todo = f"a full-rate camera makes {FRAME_BYTES_PER_S / 1e6:.0f} MB/s: record compact or elsewhere"
        return Finding("disk", Level.WARN, found, todo)
    if minutes < 1:
        return Finding("disk", Level.WARN, found, "make room, or record elsewhere")
    return Finding("disk", Level.OK, found)


def _write_speed(directory: Path) -> float:
    """Bytes per second of large writes to a file that is gone afterwards."""
    block = os.urandom(1 << 20) * 8
    with tempfile.TemporaryFile(dir=directory) as file:
        began_s = time.perf_counter()
        for _ in range(DISK_SAMPLE_MB // 8):
            file.write(block)
        file.flush()
        os.fdatasync(file.fileno())
        return (DISK_SAMPLE_MB << 20) / (time.perf_counter() - began_s)


def _projectors() -> Iterator[tuple[str, Path]]:
    for device in Path("/sys/bus/usb/devices").glob("*"):
        try:
            identity = tuple((device / name).read_text().strip() for name in ("idVendor", "idProduct"))
            bus, number = (int((device / name).read_text()) for name in ("busnum", "devnum"))
        except (OSError, ValueError):
            continue
        if identity in PROJECTORS:
            yield PROJECTORS[identity], Path(f"/dev/bus/usb/{bus:03d}/{number:03d}")


def _cpu_field(name: str) -> str:
    """The first value of a field of /proc/cpuinfo."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return ""
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(name)), "")


def _requirement_name(requirement: str) -> str:
    for index, character in enumerate(requirement):
        if character in "<>=!~ ;[":
            return requirement[:index].lower().replace("_", "-")
    return requirement.lower().replace("_", "-")


def _megabytes(size: int) -> str:
    return "unlimited" if size == resource.RLIM_INFINITY else f"{size >> 20} MB"


def _show(findings: list[Finding]) -> None:
    from rich import box
    from rich import print as show
    from rich.table import Table

    marks = {Level.OK: "[green]ok[/]", Level.WARN: "[yellow]warn[/]", Level.FATAL: "[bold red]fatal[/]"}
    table = Table(box=box.SIMPLE_HEAD, show_header=False)
    for finding in findings:
        text = finding.found + (f"\n[yellow]→ {finding.todo}[/]" if finding.todo else "")
        table.add_row(marks[finding.level], finding.name, text)
    show(table)
