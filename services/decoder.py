"""Frames in, clouds and depth maps out: at camera rate in the continuous mode, once per sequence
otherwise."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AliasChoices, Field

from endo3d.schemas import topics
from endo3d.schemas.messages import (
    POINT,
    CameraCalibration,
    Cloud,
    DepthMap,
    Frame,
    Message,
    ProjectorCalibration,
)
from endo3d.services.runtime import service
from endo3d.services.runtime.errors import UserError
from endo3d_core import patterns, triangulation
from endo3d_core.binning import BINS
from endo3d_core.bow import Bow
from endo3d_core.calibration import Lens, Rig
from endo3d_core.conventional import Conventional
from endo3d_core.fibre import CoreMap
from endo3d_core.fibre_operator import FibreOperator, FibreSensor
from endo3d_core.head import Head
from endo3d_core.interleaved import Form, Interleaved
from endo3d_core.projector_field import SUPPORT, ProjectorField, depth_limits
from endo3d_core.uncertainty import Sensor

GRID_WIDTH = 480
"""About the fibre's resolution: bins are chosen to come near it."""
CHANNELS = 6
"""Of a point: x y z intensity quality sigma."""
DEPTH_STEPS = 65_000
"""Of a depth map over the depth range: 0.1 um for 7 mm."""
FULL_WELL_ELECTRONS = 32_000.0
READ_NOISE_ELECTRONS = 7.0
SATURATION = 0.98
"""Of the grey range: what lies above counts as clipped."""


class DecoderConfig(service.Config):
    head: str = ""
    """Calibration file to start with; calibration messages replace it."""
    fibre: str = ""
    """Map of the camera fibre's cores (``endo3d calibrate fibre``): the honeycomb goes and crosstalk is undone. By
    default the one that the head's file names (``head: fibre: core_map:``, beside it)."""
    bin_px: Literal[1, 2, 4] | None = None
    """Camera pixels per grid step; by default as many as make a grid of about the fibre's resolution."""
    form: Form = Field("reuse", validation_alias=AliasChoices("form", "mode"))
    """How the continuous mode is decoded."""
    z_min_mm: float | None = None
    z_max_mm: float | None = None
    """Depth range; by default the head's."""
    dark_grey: float = 2.0
    """Mean grey value below which nothing is measured, of 255."""
    fit: bool = True
    """Fit the samples beyond the band-pass: exact at edges and on small objects, for about half the step's time."""
    cloud: bool = True
    """Publish the cloud; without it and with ``bin_px = 1`` full-resolution depth maps are left, at camera rate."""
    depth: bool = True
    """Publish the 16-bit depth map."""


class Decoder(service.Service[DecoderConfig]):
    """Decodes whatever pattern set the frames say they show."""

    Config = DecoderConfig
    reads = (topics.FRAME, topics.CAMERA, topics.PROJECTOR)
    writes = (topics.CLOUD, topics.DEPTH)

    def __init__(self, config: DecoderConfig) -> None:
        super().__init__(config)
        self.rig: Rig | None = None
        self._core_map = Path(config.fibre) if config.fibre else None
        self.z_range_mm = (0.0, 0.0)
        self._camera: CameraCalibration | None = None
        self._projector: ProjectorCalibration | None = None
        self._decoders: dict[tuple[str, tuple[int, ...], str], Interleaved | Conventional] = {}
        self._lookups: dict[tuple[int, int, int, patterns.Axis], triangulation.Lookup] = {}
        self._current: Interleaved | Conventional | None = None
        self._head: Head | None = None
        self._limits: dict[tuple[int, int, int], NDArray[np.float32]] = {}
        self._fields: dict[Interleaved | Conventional, ProjectorField] = {}
        self._window: deque[tuple[int, int]] = deque(maxlen=8)
        self._last: tuple[int, int] | None = None
        self._counts = {"windows_dropped": 0.0, "valid_share": 0.0}

    def open(self) -> None:
        """Read the head's file, if there is one."""
        if not self.config.head:
            return
        try:
            text = Path(self.config.head).read_text()
            self._calibrate(Rig.from_yaml(text), text)
        except (OSError, ValueError) as error:
            raise UserError(f"decoder: {self.config.head}: {error}") from error
        if "core_map" in text and not self.config.fibre:
            self._core_map = Path(self.config.head).parent / Head.from_yaml(text).core_map

    def warm(self) -> None:
        """Compile every kernel on a small image; with a core map on a whole one, whose operator takes long to make."""
        if self.rig is None:
            return
        self._lookup(self.rig, self.config.bin_px or _bins_for(self.rig.camera.width), "columns")
        rig, bins = self.rig, [_bins_for(self.rig.camera.width)]
        if self._core_map is None:
            rig, bins = Rig(rig.camera.binned(8), rig.projector, rig.R, rig.t), [2, 4]
        image = np.full((rig.camera.height, rig.camera.width), 100, np.uint8)
        for text in ("interleaved f1=3", "conventional f=4/3 steps=3/2"):
            for bin_px in [self.config.bin_px] if self.config.bin_px else bins:
                decoder = self._build(text, rig, bin_px, np.dtype(np.uint8))
                points = np.empty((decoder.lookup.height, decoder.lookup.width, CHANNELS), np.float32)
                for k in range(decoder.frames):
                    decoder.push(image, k % len(patterns.parse(text)))
                depth = np.empty(points.shape[:2], np.uint16)
                decoder.decode(triangulation.output(points, depth=depth))
                if decoder in self._fields:
                    self._fields.pop(decoder).keep(points, depth)

    def step(self, message: Message) -> Iterator[Message]:
        match message:
            case Frame():
                yield from self._frame(message)
            case CameraCalibration():
                self._camera = message
                self._calibrate_from_messages()
            case ProjectorCalibration():
                self._projector = message
                self._calibrate_from_messages()

    def void(self) -> None:
        """No later window may hold that frame."""
        if self._current is not None:
            self._counts["windows_dropped"] += 1.0
            self._current.reset()

    def values(self) -> Mapping[str, float]:
        return self._counts

    def _frame(self, frame: Frame) -> Iterator[Message]:
        decoder = self._decoder_for(frame)
        if decoder is None:
            return
        if self._last not in (None, (frame.epoch, frame.sequence - 1)):
            # A lost frame or another start of the projector: these never decode together.
            self._counts["windows_dropped"] += 1.0
            if self._last is not None and self._last[0] != frame.epoch:
                decoder.restart()
            decoder.reset()
        self._last = (frame.epoch, frame.sequence)
        self._window.append((frame.stamp_ns, frame.sequence))
        if decoder.push(frame.image, frame.slot):
            yield from self._publish(frame, decoder)

    def _publish(self, frame: Frame, decoder: Interleaved | Conventional) -> Iterator[Message]:
        stamp_ns, sequence = self._window[-1 - decoder.latency]
        shape = (decoder.lookup.height, decoder.lookup.width)
        if decoder.lookup.axis == "rows":
            shape = shape[::-1]
        points = self.loan(topics.CLOUD, shape, POINT) if self.config.cloud else None
        depth = self.loan(topics.DEPTH, shape, np.uint16) if self.config.depth else None
        z_min, z_max = self.z_range_mm
        scale = (z_max - z_min) / DEPTH_STEPS
        channels = None if points is None else points.view(np.float32).reshape(*shape, CHANNELS)
        valid = decoder.decode(triangulation.output(channels, depth=depth, scale_mm=scale, offset_mm=z_min - scale))
        field = self._fields.get(decoder)
        if field is not None and channels is not None:
            valid = field.keep(channels, depth)
        self._counts["valid_share"] = valid / (shape[0] * shape[1])
        grid_px = float(decoder.bin_px)
        if points is not None:
            yield Cloud(
                stamp_ns=stamp_ns,
                sequence=sequence,
                points=points,
                window_frames=decoder.frames,
                newest_stamp_ns=frame.stamp_ns,
                epoch=frame.epoch,
                pattern_set=frame.pattern_set,
                grid_px=grid_px,
                valid_count=valid,
                slot_slips=decoder.slots.slips if isinstance(decoder, Interleaved) else 0,
                frame_id=frame.frame_id,
            )
        if depth is not None:
            yield DepthMap(stamp_ns, sequence, depth, scale, z_min - scale, grid_px, frame.frame_id)

    def _decoder_for(self, frame: Frame) -> Interleaved | Conventional | None:
        """The decoder of this frame's pattern set and size; None before any calibration came."""
        if self.rig is None:
            return None
        key = (frame.pattern_set, frame.image.shape, frame.image.dtype.str)
        if key not in self._decoders:
            rig = replace(self.rig, camera=_lens_of(self.rig.camera, frame))
            bin_px = self.config.bin_px or _bins_for(frame.image.shape[1])
            self._decoders[key] = self._build(frame.pattern_set, rig, bin_px, frame.image.dtype)
        decoder = self._decoders[key]
        if self._current is not decoder:
            decoder.reset()
            self._current = decoder
        return decoder

    def _build(
        self, text: str, rig: Rig, bin_px: int, dtype: np.dtype[np.uint8] | np.dtype[np.uint16]
    ) -> Interleaved | Conventional:
        pattern_set = patterns.parse(text)
        front, sensor, saturation_grey = self._front(rig, bin_px, dtype)
        lookup = self._lookup(rig, bin_px, pattern_set.axis)
        dark_grey = self.config.dark_grey * float(np.iinfo(dtype).max) / 255.0
        decoder: Interleaved | Conventional
        if pattern_set.kind == "interleaved":
            decoder = Interleaved(
                pattern_set, lookup, bin_px, dtype, form=self.config.form, fit=self.config.fit, front=front,
                dark_grey=dark_grey, saturation_grey=saturation_grey, sensor=sensor,
            )  # fmt: skip
        else:
            decoder = Conventional(
                pattern_set, lookup, bin_px, dtype, front=front, dark_grey=dark_grey, saturation_grey=saturation_grey,
                sensor=sensor,
            )  # fmt: skip
        if self._head is not None:
            # The continuous mode has compared neighbours already.
            support = 0 if isinstance(decoder, Interleaved) else SUPPORT
            limits = self._limits[rig.camera.width, rig.camera.height, bin_px]
            self._fields[decoder] = ProjectorField(limits, support)
        return decoder

    def _lookup(self, rig: Rig, bin_px: int, axis: patterns.Axis) -> triangulation.Lookup:
        """Of a camera format: frames would be lost while it is made, so it is made before the first and kept."""
        key = rig.camera.width, rig.camera.height, bin_px, axis
        if key not in self._lookups:
            self._lookups[key] = triangulation.build(rig, bin_px, *self.z_range_mm, axis)
            if self._head is not None:
                self._limits[key[:3]] = depth_limits(rig, self._head, bin_px, *self.z_range_mm)
        return self._lookups[key]

    def _front(
        self, rig: Rig, bin_px: int, dtype: np.dtype[np.uint8] | np.dtype[np.uint16]
    ) -> tuple[FibreOperator | None, Sensor, float | None]:
        """What fills the grids instead of binning, the noise of its samples, and from which grey on they saturate."""
        full_grey = float(np.iinfo(dtype).max)
        plain = Sensor(FULL_WELL_ELECTRONS / full_grey, READ_NOISE_ELECTRONS)
        if self._core_map is None:
            return None, plain, None
        try:
            front = _operator(self._core_map, rig.camera.width, rig.camera.height, bin_px, full_grey).another()
        except (OSError, ValueError) as error:
            raise UserError(f"decoder: {self._core_map}: {error}") from error
        sensor = FibreSensor(plain.electrons_per_grey, plain.read_noise_electrons, front.noise_gains)
        return front, sensor, math.inf

    def _calibrate_from_messages(self) -> None:
        camera, projector = self._camera, self._projector
        if camera is None or projector is None:
            return
        T = projector.T_projector_camera
        rig = Rig(
            Lens(camera.width, camera.height, camera.K, camera.dist),
            Lens(projector.width, projector.height, projector.K, projector.dist),
            T[:3, :3],
            T[:3, 3],
            Bow.from_yaml(projector.yaml),
        )
        self._calibrate(rig, projector.yaml)
        self._lookup(rig, self.config.bin_px or _bins_for(rig.camera.width), "columns")

    def _calibrate(self, rig: Rig, yaml: str) -> None:
        """Take a calibration, unless it is the one in use: then the windows go on."""
        z_min, z_max = self.config.z_min_mm, self.config.z_max_mm
        head = Head.from_yaml(yaml) if "head:" in yaml or z_min is None or z_max is None else None
        if head is not None:
            z_min, z_max = z_min or head.z_min_mm, z_max or head.z_max_mm
        assert z_min is not None
        assert z_max is not None
        if self.rig is not None and rig.to_yaml() == self.rig.to_yaml() and self.z_range_mm == (z_min, z_max):
            return
        self.rig, self.z_range_mm, self._head = rig, (z_min, z_max), head
        self._decoders.clear()
        self._lookups.clear()
        self._limits.clear()
        self._fields.clear()
        self._current = None


@lru_cache(maxsize=4)
def _operator(core_map: Path, width: int, height: int, bin_px: int, full_grey: float) -> FibreOperator:
    """For images of that size, which a camera may have binned; making it takes seconds."""
    cores = CoreMap.from_npz(core_map.read_bytes())
    factor = cores.flat.shape[1] // width
    if factor < 1 or cores.flat.shape != (height * factor, width * factor):
        raise ValueError(f"the core map is of {cores.flat.shape[1]}x{cores.flat.shape[0]}, frames of {width}x{height}")
    operator = FibreOperator(cores if factor == 1 else cores.binned(factor), bin_px, SATURATION * full_grey)
    operator.noise_gains  # noqa: B018  measured once, for all
    return operator


def _bins_for(width_px: int) -> int:
    return min(BINS, key=lambda bin_px: abs(width_px / bin_px - GRID_WIDTH))


def _lens_of(camera: Lens, frame: Frame) -> Lens:
    """The calibrated camera, binned to the frame's size if the camera bins. Raises ``UserError``
    otherwise."""
    height, width = frame.image.shape
    factor = camera.width // width
    if factor < 1 or (width * factor, height * factor) != (camera.width, camera.height):
        raise UserError(
            f"decoder: frames of {width}x{height}, calibration of {camera.width}x{camera.height}; "
            "use the calibration of this camera format"
        )
    return camera if factor == 1 else camera.binned(factor)
