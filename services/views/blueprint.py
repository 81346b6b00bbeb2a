"""How Rerun is laid out: the cloud large, what the camera sees beside it, how well it goes below."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import rerun.blueprint as rrb
from numpy.typing import NDArray

from endo3d.services.views import entries


@dataclass(frozen=True)
class Stand:
    """From where the cloud is seen first, all (3,), mm."""

    position: NDArray[np.floating]
    target: NDArray[np.floating]
    up: NDArray[np.floating]


NIGHT = (24, 26, 31)
BEFORE_ANY_MAP = Stand(np.array([-10.0, 27.0, -12.0]), np.array([2.0, 1.0, 12.0]), np.array([0.0, 0.0, -1.0]))
"""The world is the first camera's: the surface lies 10..20 mm along z."""


def scan_blueprint(stand: Stand = BEFORE_ANY_MAP) -> rrb.Blueprint:
    """Merged cloud, way and frustum; live image, depth map; plots of rate, latency, residual and sigma."""
    plots = entries.PLOTS
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Tabs(
                    rrb.Spatial3DView(
                        origin="/" + entries.WORLD,
                        name="map",
                        contents=["+ $origin/**", f"- /{entries.PROJECTOR}/**", f"- /{entries.CLOUD}"],
                        background=NIGHT,
                        line_grid=False,
                        eye_controls=rrb.EyeControls3D(
                            kind=rrb.Eye3DKind.Orbital,
                            position=stand.position,
                            look_target=stand.target,
                            eye_up=stand.up,
                        ),
                    ),
                    rrb.Spatial3DView(origin="/" + entries.CAMERA, name="cloud", background=NIGHT, line_grid=False),
                ),
                rrb.Horizontal(
                    rrb.TimeSeriesView(
                        origin=f"/{plots}/pose",
                        contents=["+ $origin/residual_um", "+ $origin/sigma_weak_um"],
                        name="residual, sigma / um",
                    ),
                    rrb.TimeSeriesView(origin=f"/{plots}/rate_hz", name="rate / Hz"),
                    rrb.TimeSeriesView(origin=f"/{plots}/latency_p50_ms", name="latency / ms"),
                ),
                row_shares=[3, 1],
            ),
            rrb.Vertical(
                rrb.Spatial2DView(origin="/" + entries.IMAGE, name="camera"),
                rrb.Spatial2DView(origin="/" + entries.DEPTH, name="depth"),
                rrb.TextLogView(origin="/" + entries.LOG, name="log"),
                row_shares=[3, 3, 1.5],
            ),
            column_shares=[2.4, 1],
        ),
        rrb.TimePanel(state="collapsed", timeline="time", play_state="following"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        collapse_panels=True,
    )
