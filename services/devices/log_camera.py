"""``log:``: a recording is played by the player service, which is its camera, projector and truth at once."""

from __future__ import annotations

from typing import NoReturn

from endo3d.services.devices.uri import DeviceError, Setting, Uri


def open_uri(uri: Uri, setting: Setting) -> NoReturn:
    raise DeviceError(
        f"device {uri.text!r}: replace the tables [sequencer] and [grabber] by [player] with log = "
        f"{uri.body or 'PATH'!r}: it publishes the frames as they were labelled"
    )
