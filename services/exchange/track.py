"""The way of the tip as text: TUM (m, for trajectory tools) or CSV (mm, with uncertainty and state)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from endo3d.schemas.messages import Pose, Tracking
from endo3d.services.runtime.errors import UserError
from endo3d_core import trajectory

SUFFIXES = (".tum", ".txt", ".csv")


def write_track(poses: Sequence[Pose], path: str | Path) -> int:
    """Writes poses by the suffix and returns how many: TUM leaves lost ones out, CSV names every state.

    Raises ``UserError`` for another suffix.
    """
    target = Path(path)
    suffix = target.suffix.lower()
    if suffix not in SUFFIXES:
        raise UserError(f"no trajectory format {suffix!r}; choose {', '.join(SUFFIXES)}")
    if suffix == ".csv":
        kept = list(poses)
        text = trajectory.to_csv(
            [pose.stamp_ns for pose in kept],
            [pose.T_world_camera for pose in kept],
            [pose.information for pose in kept],
            [pose.sigma_weak_um for pose in kept],
            [pose.state.value for pose in kept],
        )
    else:
        kept = [pose for pose in poses if pose.state is not Tracking.LOST]
        text = trajectory.to_tum([pose.stamp_ns for pose in kept], [pose.T_world_camera for pose in kept])
    target.write_text(text)
    return len(kept)
