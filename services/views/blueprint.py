"""How Rerun is laid out: the cloud large, what the camera sees beside it, how well it goes below."""

from __future__ import annotations

import rerun.blueprint as rrb

from endo3d.services.views import entries


def scan_blueprint() -> rrb.Blueprint:
    """Merged cloud, way and frustum; live image, depth map; plots of rate, latency, residual and sigma."""
    plots = entries.PLOTS
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Spatial3DView(
                    origin="/" + entries.WORLD,
                    name="map",
                    contents=["+ $origin/**", f"- /{entries.PROJECTOR}/**"],
                    background=(24, 26, 31),
                    line_grid=False,
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
