"""How the viewer is laid out: paths over errors on the left; signals, biases and the report in tabs on the right."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64

from imutool.view.rerun.sdk import entity_path, need_sdk
from imutool.view.rundata import RunData

if TYPE_CHECKING:
    import rerun.blueprint as rrb

READABLE = 10.0  # an error this many times smaller than the plot is high can still be read


def blueprint(logs: Sequence[RunData]) -> rrb.Blueprint:
    """The layout of the first log."""
    return _of_one(logs[0])


def _of_one(data: RunData) -> rrb.Blueprint:
    """The layout: paths over errors on the left, tabs for signals, biases and the report on the right; no empty panel.

    Raises:
        ConfigError: Rerun is not installed.
    """
    need_sdk()
    import rerun.blueprint as rrb

    left: list[Any] = [rrb.Spatial3DView(origin="/world", name="Paths", eye_controls=_eye(data), background=(24, 26, 30))]
    if data.truth is not None:
        left += [
            _plot(
                data, "/error/orientation", "Orientation error (deg)", _totals(data, "orientation"), limit(data, "orientation")
            ),
            _plot(data, "/error/position", "Position error (m)", _totals(data, "position"), limit(data, "position")),
        ]
    tabs: list[Any] = [
        rrb.Vertical(
            _plot(data, "/imu/gyro", "Angular rate (rad/s)"),
            _plot(data, "/imu/accel", "Specific force (m/s²)"),
            name="Signals",
        )
    ]
    if data.models() or data.true_bias:
        units = {"gyro": "Gyro bias (rad/s)", "accel": "Accel bias (m/s²)"}
        shown = units if data.models() else {kind: units[kind] for kind in data.true_bias}
        tabs.append(rrb.Vertical(*(_plot(data, f"/bias/{k}", title) for k, title in shown.items()), name="Bias"))
    tabs.append(rrb.TextDocumentView(origin="/report", name="Report"))
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(*left, row_shares=[2, 1, 1][: len(left)]), rrb.Tabs(*tabs, active_tab=0), column_shares=[1, 1]
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="elapsed"),
        auto_layout=False,
        auto_views=False,
    )


def _plot(
    data: RunData, origin: str, name: str, contents: str | list[str] = "$origin/**", limit: float | None = None
) -> rrb.TimeSeriesView:
    """A plot over the whole log: by default Rerun shows a minute around the cursor."""
    import rerun as rr
    import rerun.blueprint as rrb

    ends = [rr.TimeRangeBoundary.absolute(seconds=t) for t in (0.0, data.duration_s)]
    return rrb.TimeSeriesView(
        origin=origin,
        contents=contents,
        name=name,
        axis_x=rrb.TimeAxis(link="Independent", view_range=rr.TimeRange(start=ends[0], end=ends[1])),
        axis_y=None if limit is None else rrb.ScalarAxis(range=(0.0, limit)),
        plot_legend=rrb.Corner2D.LeftTop,
    )


def _totals(data: RunData, kind: str) -> list[str]:
    """The entities of the total errors."""
    return [entity_path("error", kind, trace.name, "total") for trace in data.traces if trace.errors is not None]


def limit(data: RunData, kind: str) -> float | None:
    """How high an error plot reaches: a raw error that would make the models' flat lines leaves the plot."""
    tops = {}
    for trace in data.traces:
        if trace.errors is not None:
            total = trace.errors.orientation_total_deg if kind == "orientation" else trace.errors.position_total_m
            tops[trace.name] = float(np.nanmax(total))
    models = [tops[trace.name] for trace in data.models() if trace.name in tops]
    highest = max(tops.values(), default=0.0)
    cut = bool(models) and highest > READABLE * max(models) > 0.0
    limit = READABLE / 2.0 * max(models) if cut else highest
    return 1.05 * limit if limit > 0.0 else None


def _eye(data: RunData) -> rrb.EyeControls3D:
    """A look at the truth (without it, at everything) from above one corner: raw paths often leave for kilometres."""
    import rerun.blueprint as rrb

    low, high = box(data)
    centre, size = (low + high) / 2.0, size_m(data)
    return rrb.EyeControls3D(position=centre + size * np.array([-0.6, -0.6, 0.4]), look_target=centre, eye_up=[0.0, 0.0, 1.0])


def box(data: RunData) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
    """The corners of what matters in 3D."""
    shown = [data.truth] if data.truth is not None else [trace.path for trace in data.traces]
    points = np.concatenate([poses.p_wb for poses in shown])
    return points.min(axis=0), points.max(axis=0)


def size_m(data: RunData) -> float:
    """The diagonal of what matters in 3D, at least a metre."""
    low, high = box(data)
    return max(float(np.linalg.norm(high - low)), 1.0)
