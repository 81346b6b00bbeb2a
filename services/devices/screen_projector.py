"""``screen:``: a monitor or HDMI projector for benches: a full-screen window by tkinter.

Options: ``x``, ``y`` (where the screen begins on the desktop, for a second screen), ``refresh_hz`` (60). A screen
shows a picture for whole refreshes, and nothing tells the camera when: use conventional sequences at a few Hz, with a
camera that films faster or is triggered by software. It has no dark time, and gamma: calibrate the response.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from threading import Event, Thread
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endo3d.services.devices.looks import looks
from endo3d.services.devices.projector import Limits, ProjectorStatus
from endo3d.services.devices.slots import timeline
from endo3d.services.devices.uri import DeviceError, Setting, Uri
from endo3d_core.calibration import Rig
from endo3d_core.patterns import PatternSet
from endo3d_core.slot_identity import Timeline

OPEN_S = 10.0
LEAD_NS = 100_000_000


def open_uri(uri: Uri, setting: Setting) -> ScreenProjector:
    corner = (int(uri.number("x", 0)), int(uri.number("y", 0)))
    refresh_hz = uri.number("refresh_hz", 60.0)
    if uri.body:
        raise DeviceError(f"device {uri.text!r}: write screen: and options")
    uri.finish()
    lens = Rig.from_yaml(setting.head_yaml).projector
    return ScreenProjector((lens.width, lens.height), corner, refresh_hz)


class ScreenProjector:
    """The window lives in a thread of its own, as tkinter wants: nothing else touches it."""

    def __init__(self, window: tuple[int, int], corner: tuple[int, int], refresh_hz: float) -> None:
        self.limits = Limits(min_exposure_us=2e6 / refresh_hz, min_dark_us=0.0)
        self._window, self._corner = window, corner
        self._images: dict[str, list[NDArray[np.uint8]]] = {}
        self._shown: tuple[Timeline, list[NDArray[np.uint8]]] | None = None
        self._opened, self._ended = Event(), Event()
        self._problem = ""
        self._thread = Thread(target=self._run, name="screen", daemon=True)
        self._thread.start()
        if not self._opened.wait(OPEN_S) or self._problem:
            raise DeviceError(
                f"no window can be opened ({self._problem or 'no answer'}); a desktop is needed: set DISPLAY, and "
                "install python3-tk if tkinter is missing"
            )

    def load(self, sets: Sequence[PatternSet]) -> None:
        self.stop()
        loaded = looks(sets, *self._window)
        pictures = [look.image * np.uint8(255 // (2**look.depth - 1)) for look in loaded.looks]
        self._images = {
            pattern_set.text: [pictures[member] for member in members]
            for pattern_set, members in zip(sets, loaded.members, strict=True)
        }

    def start(self, pattern_set: PatternSet, exposure_us: float, dark_us: float) -> int:
        images = self._images.get(pattern_set.text)
        if images is None:
            raise DeviceError(f"pattern set {pattern_set.text!r} is not loaded; name it in the sequencer's modes")
        shortest = min(pattern.exposure_us or exposure_us for pattern in pattern_set.patterns)
        if shortest < self.limits.min_exposure_us:
            raise DeviceError(
                f"exposure {shortest:g} us is too short; the screen needs {self.limits.min_exposure_us:g} us"
            )
        start_ns = self.now_ns() + LEAD_NS
        self._shown = (timeline(pattern_set, start_ns, exposure_us, dark_us), images)
        return start_ns

    def stop(self) -> None:
        self._shown = None

    def status(self) -> ProjectorStatus:
        if not self._thread.is_alive():
            return ProjectorStatus(connected=False, running=False, note="the projector's window was closed")
        return ProjectorStatus(connected=True, running=self._shown is not None)

    def now_ns(self) -> int:
        return time.time_ns()

    def close(self) -> None:
        self.stop()
        self._ended.set()
        self._thread.join(OPEN_S)

    def _run(self) -> None:
        """The window's thread: show the slot of the moment, until the end."""
        try:
            import tkinter
        except ImportError as error:
            self._problem = str(error)
            self._opened.set()
            return
        try:
            root = tkinter.Tk()
        except tkinter.TclError as error:
            self._problem = str(error)
            self._opened.set()
            return
        root.overrideredirect(True)
        root.configure(background="black", cursor="none")
        root.geometry(f"{root.winfo_screenwidth()}x{root.winfo_screenheight()}+{self._corner[0]}+{self._corner[1]}")
        picture = tkinter.Label(root, background="black", borderwidth=0)
        picture.pack(expand=True)
        root.update()
        self._opened.set()
        self._show(tkinter, root, picture)
        root.destroy()

    def _show(self, tkinter: Any, root: Any, picture: Any) -> None:
        photos: dict[int, Any] = {}
        before = -1
        while not self._ended.wait(0.001):
            shown, place = self._shown, -1
            if shown is not None:
                count = shown[0].last_begun(self.now_ns())
                place = count % shown[0].slots if count >= 0 else -1
            identity = -1 if shown is None or place < 0 else id(shown[1][place])
            if identity != before:
                before = identity
                if shown is None or place < 0:
                    picture.configure(image="")
                else:
                    if identity not in photos:
                        image = shown[1][place]  # kept, so that no other gets its identity
                        photos[identity] = (tkinter.PhotoImage(data=_portable(image), format="PPM"), image)
                    picture.configure(image=photos[identity][0])
            root.update()


def _portable(image: NDArray[np.uint8]) -> bytes:
    """A grey picture as PGM, which tkinter reads."""
    height, width = image.shape
    return b"P5 %d %d 255\n" % (width, height) + image.tobytes()
