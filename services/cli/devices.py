"""``endo3d devices``: which cameras and projectors are attached, which could be, and what is missing for them."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from enum import StrEnum
from importlib.util import find_spec
from pathlib import Path

from endo3d.services.cli.options import JsonOption

RULE = "copy deploy/udev/70-endo3d.rules to /etc/udev/rules.d, run `udevadm control --reload`, plug it in again"


class State(StrEnum):
    READY = "ready"
    NONE = "none attached"
    CLOSED = "no permission"
    MISSING = "not installed"


@dataclass(frozen=True, slots=True)
class Found:
    """One way to get at a device: what is there, and what to do if it isn't."""

    role: str
    uri: str
    state: State
    what: str = ""
    todo: str = ""


def devices(as_json: JsonOption = False) -> None:
    """List cameras and projectors: what is attached, and what is missing to use it.

    The first column is what a stack file wants: [sequencer] projector = "...", [grabber] camera = "...".

    Examples: endo3d devices; endo3d devices --json
    """
    found = [*projectors(), *cameras()]
    if as_json:
        print(json.dumps([asdict(each) for each in found], indent=2))
    else:
        _show(found)


def projectors() -> Iterator[Found]:
    """Every projector driver, and what it finds."""
    from endo3d.services.devices.dlp_link import VENDOR
    from endo3d.services.devices.dlpc350_projector import PRODUCT as DLPC350
    from endo3d.services.devices.dlpc900_controller import PRODUCT as DLPC900

    yield Found("projector", "sim:", State.READY, "the virtual rig's, or dlpc900:emulated")
    for scheme, product, name in (
        ("dlpc900:", DLPC900, "LightCrafter 6500, 9000"),
        ("dlpc350:", DLPC350, "LightCrafter 4500"),
    ):
        yield _on_usb(scheme, VENDOR, product, name)
    if find_spec("ALP4") is None:
        yield Found("projector", "alp:", State.MISSING, "ViALUX ALP-4", "pip install 'endo3d[alp]' and ViALUX' library")
    else:
        yield Found("projector", "alp:", State.READY, "ALP4lib is there; ViALUX' library shows when it is opened")
    yield _screen()


def _on_usb(scheme: str, vendor: int, product: int, name: str) -> Found:
    import usb.core

    try:
        attached = list(usb.core.find(find_all=True, idVendor=vendor, idProduct=product))
    except usb.core.NoBackendError:
        return Found("projector", scheme, State.MISSING, name, "apt install libusb-1.0-0")
    nodes = [Path(f"/dev/bus/usb/{device.bus:03d}/{device.address:03d}") for device in attached]
    if not nodes:
        return Found("projector", scheme, State.NONE, name, "plug it into USB and switch it on")
    where = ", ".join(str(node) for node in nodes)
    if any(node.exists() and not os.access(node, os.R_OK | os.W_OK) for node in nodes):
        return Found("projector", scheme, State.CLOSED, f"{name} at {where}", RULE)
    return Found("projector", scheme, State.READY, f"{name} at {where}")


def _screen() -> Found:
    if find_spec("tkinter") is None:
        return Found("projector", "screen:", State.MISSING, "a monitor", "apt install python3-tk")
    display = os.environ.get("DISPLAY")
    if not display:
        return Found("projector", "screen:", State.NONE, "a monitor", "start it on a desktop, or set DISPLAY")
    return Found("projector", "screen:", State.READY, f"display {display}")


def cameras() -> Iterator[Found]:
    """Every camera driver, and what it finds."""
    yield Found("camera", "sim:contour", State.READY, "the virtual rig's")
    yield Found("camera", "folder:PATH", State.READY, "images of a folder, one per pattern")
    yield from _aravis()
    yield from _gentl()
    nodes = sorted(Path("/dev").glob("video*"), key=lambda node: int(node.name[5:] or 0))
    for node in nodes:
        open_ = os.access(node, os.R_OK | os.W_OK)
        yield Found(
            "camera", f"uvc:{node}", State.READY if open_ else State.CLOSED, _name_of(node),
            "" if open_ else "add yourself to the group video: usermod -aG video $USER, and log in again",
        )  # fmt: skip
    if not nodes:
        yield Found("camera", "uvc:N", State.NONE, "video endoscopes and webcams", "plug one in: /dev/video0 appears")


def _aravis() -> Iterator[Found]:
    from endo3d.services.devices.aravis_camera import library
    from endo3d.services.devices.uri import DeviceError

    try:
        aravis = library()
    except DeviceError as error:
        yield Found("camera", "aravis:", State.MISSING, "USB3 Vision and GigE Vision", str(error).partition("; ")[2])
        return
    aravis.update_device_list()
    for index in range(aravis.get_n_devices()):
        model = f"{aravis.get_device_vendor(index)} {aravis.get_device_model(index)}"
        where = f"{aravis.get_device_protocol(index)} {aravis.get_device_address(index)}"
        yield Found("camera", f"aravis:{aravis.get_device_id(index)}", State.READY, f"{model} ({where})")
    if not aravis.get_n_devices():
        yield Found("camera", "aravis:", State.NONE, "USB3 Vision and GigE Vision", "plug one in; " + RULE)


def _gentl() -> Iterator[Found]:
    from endo3d.services.devices.gentl_camera import PATHS, installed_producers

    what = "any camera with a GenTL producer"
    if find_spec("harvesters") is None:
        yield Found("camera", "gentl:", State.MISSING, what, "pip install 'endo3d[gentl]'")
        return
    producers = installed_producers()
    for path in producers:
        yield Found("camera", f"gentl:{path}", State.READY, "a vendor's GenTL producer")
    if not producers:
        yield Found("camera", "gentl:", State.MISSING, what, f"install the vendor's producer (it sets {PATHS})")


def _name_of(node: Path) -> str:
    try:
        return (Path("/sys/class/video4linux") / node.name / "name").read_text().strip()
    except OSError:
        return "video"


def _show(found: list[Found]) -> None:
    from rich import box
    from rich import print as show
    from rich.markup import escape
    from rich.table import Table

    colours = {State.READY: "green", State.NONE: "dim", State.CLOSED: "yellow", State.MISSING: "dim"}
    for role in ("projector", "camera"):
        table = Table(box=box.SIMPLE_HEAD, title=f"{role}s", title_justify="left", show_header=False)
        for each in found:
            if each.role == role:
                text = escape(each.what) + (f"\n[yellow]→ {escape(each.todo)}[/]" if each.todo else "")
                table.add_row(escape(each.uri), f"[{colours[each.state]}]{each.state}[/]", text)
        show(table)
