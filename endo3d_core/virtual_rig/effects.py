"""Which parts of the image formation are simulated: each can be switched off, to show its share."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace


@dataclass(frozen=True, slots=True)
class Effects:
    """In the order of the light's way."""

    projector_fibre: bool = True
    """The pattern is sampled by jittered hexagonal cores that leak into each other."""
    projector_defocus: bool = True
    specular: bool = True
    ambient: bool = True
    vignetting: bool = True
    """The camera's cos^4 and vignette."""
    shadows: bool = True
    camera_defocus: bool = True
    camera_fibre: bool = True
    """Cores average, differ in gain, leak into each other, and are imaged as discs."""
    crosstalk: bool = True
    """Of both fibres."""
    noise: bool = True
    """Shot and read noise."""
    quantisation: bool = True
    motion_blur: bool = True
    """Several poses within an exposure."""

    def without(self, *names: str) -> Effects:
        """The same with some switched off. Raises ``ValueError`` for an unknown name."""
        known = [f.name for f in fields(self)]
        for name in names:
            if name not in known:
                raise ValueError(f"unknown effect {name!r}; it is one of: {', '.join(known)}")
        return replace(self, **dict.fromkeys(names, False))


FULL = Effects()
FAST = FULL.without("projector_fibre", "projector_defocus", "camera_defocus", "camera_fibre", "motion_blur")
"""What a single core renders live."""
IDEAL = Effects(**{f.name: False for f in fields(Effects)})
PRESETS = {"full": FULL, "fast": FAST, "ideal": IDEAL}
