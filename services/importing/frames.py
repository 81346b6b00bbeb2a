"""Described images as the messages that a grabber would have published."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from numpy.typing import NDArray

from endo3d.schemas.messages import CameraCalibration, Frame, Message, ProjectorCalibration
from endo3d.services.importing.capture import Capture
from endo3d.services.runtime.stack_file import to_toml


def calibration(capture: Capture, stamp_ns: int) -> Iterator[Message]:
    """What the images were taken with."""
    camera, projector = capture.rig.camera, capture.rig.projector
    yield CameraCalibration(stamp_ns, camera.width, camera.height, camera.K, camera.dist)
    yield ProjectorCalibration(
        stamp_ns, projector.width, projector.height, projector.K, projector.dist,
        capture.rig.T_projector_camera, capture.yaml,
    )  # fmt: skip


def frames(capture: Capture, images: Iterable[NDArray[Any]], start_ns: int) -> Iterator[Frame]:
    """One frame per image, at the stated rate; each pass through a pattern set of several is an epoch."""
    period_ns = round(1e9 / capture.table.rate_hz)
    alone = len(capture.sets) == 1
    for sequence, image in enumerate(images):
        cycle, index = divmod(sequence, len(capture.table.pattern))
        number = 0
        while index >= len(capture.sets[number]):
            index -= len(capture.sets[number])
            number += 1
        shown = capture.sets[number]
        exposure_us = shown[index].exposure_us or capture.table.exposure_us
        trigger_ns = start_ns + sequence * period_ns
        yield Frame(
            stamp_ns=trigger_ns + round(500 * exposure_us),
            sequence=sequence,
            image=image,
            pattern_set=shown.text,
            slot=index,
            epoch=1 if alone else 1 + cycle * len(capture.sets) + number,
            exposure_us=exposure_us,
            trigger_ns=trigger_ns,
            camera_frame_id=sequence,
        )


def stack_toml(capture: Capture) -> str:
    """The stack that decodes these images; the log carries it."""
    z_min_mm, z_max_mm = capture.z_mm
    return to_toml(
        {
            "rig": {"name": "import", "head": "calibration.yaml"},
            "decoder": {"z_min_mm": z_min_mm, "z_max_mm": z_max_mm, "bin_px": 1},
        }
    )
