"""What a sensor head is apart from its calibration: the ``head`` section of a head's YAML file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import yaml


@dataclass(frozen=True, slots=True)
class Head:
    """A sensor head's design figures. Lengths along the camera's axis unless said otherwise."""

    base_mm: float
    working_distance_mm: float
    field_mm: float
    """Diameter of the field at the working distance."""
    z_min_mm: float
    z_max_mm: float
    fibre_diameter_mm: float
    fibre_pitch_um: float
    camera_circle_px: float
    """Diameter of the camera fibre's image, in pixels of the calibration's camera."""
    projector_circle_px: float
    """Diameter of what the projector fibre sees of the pattern generator."""
    defocus_per_mm: float
    """Growth of the blur's sigma at the object per length out of focus."""
    core_map: str = ""
    """File of the camera fibre's core map, beside the head's; ``fibre: core_map:``."""

    @property
    def camera_pitch_px(self) -> float:
        """Spacing of the fibre's cores on the camera."""
        return self.fibre_pitch_um * 1e-3 / self.fibre_diameter_mm * self.camera_circle_px

    @property
    def projector_pitch_px(self) -> float:
        """Spacing of the fibre's cores on the pattern generator."""
        return self.fibre_pitch_um * 1e-3 / self.fibre_diameter_mm * self.projector_circle_px

    @classmethod
    def from_yaml(cls, text: str) -> Head:
        """The ``head`` section of a head's file. Raises ``ValueError`` that names what is missing."""
        try:
            tree = yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise ValueError(f"the head's file is not YAML: {str(error).splitlines()[0]}") from error
        section = tree.get("head") if isinstance(tree, Mapping) else None
        if not isinstance(section, Mapping):
            raise ValueError("the calibration has no 'head' section; take one from the head files in deploy/heads")
        flat: dict[str, Any] = dict(section)
        for key, value in dict(flat.pop("fibre", {})).items():
            flat[f"fibre_{key}"] = value
        numbers = [f.name for f in fields(cls) if f.name != "core_map"]
        missing = [name for name in numbers if name not in flat]
        if missing:
            raise ValueError(f"the head section has no {missing[0].replace('fibre_', 'fibre.')!r}")
        core_map = str(flat.get("fibre_core_map", ""))
        return cls(**{name: float(flat[name]) for name in numbers}, core_map=core_map)
