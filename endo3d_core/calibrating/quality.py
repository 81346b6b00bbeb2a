"""How good a calibration is, in the words and numbers that travel with it: its file's section ``quality``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import yaml

SECTION = "quality"


@dataclass(frozen=True, slots=True)
class Quality:
    """As it stands in the file."""

    state: str
    """``good`` or ``bad``; ``design`` when nobody calibrated."""
    reason: str = ""
    """Why it is bad."""
    poses: int = 0
    rejected: tuple[str, ...] = ()
    reprojection_px: tuple[float, float] = (0.0, 0.0)
    """Root mean square of the error's length, camera and projector."""
    depth_sigma_um: float = 0.0
    """The largest standard deviation of a depth in the volume, as far as the parameters decide it."""
    coverage: float = 0.0
    """Share of the field in which features were seen."""
    flatness_um: tuple[float, float] | None = None
    """Of the flat reference, root mean square before and after the correction."""
    gamma: float | None = None
    verified: str = ""
    """What ``verify`` found, and when."""
    sigma: Mapping[str, float] = field(default_factory=dict)
    """Standard deviation of each parameter."""

    @property
    def line(self) -> str:
        """One line for people."""
        if self.state == "design":
            return "calibration: design figures, nobody has calibrated this rig"
        seen = f"{self.poses} poses, {max(self.reprojection_px):.3f} px, depth sigma {self.depth_sigma_um:.2f} um"
        bad = f"BAD ({self.reason})" if self.state == "bad" else "good"
        return f"calibration: {bad}, {seen}" + (f", verified: {self.verified}" if self.verified else "")

    def to_yaml(self) -> str:
        """The section, to be appended to a calibration file."""
        tree = {key: _plain(value) for key, value in asdict(self).items() if value not in (None, "", {}, ())}
        return str(yaml.safe_dump({SECTION: tree}, sort_keys=False, width=1000))

    @classmethod
    def from_yaml(cls, text: str) -> Quality:
        """Of a whole calibration file; without the section its figures are a design's."""
        try:
            tree = yaml.safe_load(text) if text else None
            section = tree.get(SECTION) if isinstance(tree, Mapping) else None
            if section is None:
                return cls("design")
            flat: dict[str, Any] = dict(section)
            for key in ("rejected", "reprojection_px", "flatness_um"):
                if flat.get(key) is not None:
                    flat[key] = tuple(flat[key])
            return cls(**flat)
        except (yaml.YAMLError, TypeError, ValueError) as error:
            raise ValueError(f"the calibration's {SECTION} section is not what calibrate writes") from error


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(v) for key, v in value.items()}
    if isinstance(value, tuple):
        return [_plain(v) for v in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value
