"""How the viewer is laid out: paths over errors on the left, all else in tabs on the right; several logs side by side first."""

from __future__ import annotations

import colorsys
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64

from imutool.viewing.model.run_data import RunData, Trace
from imutool.viewing.rerun import panels
from imutool.viewing.rerun.entities import clock, errors, names, styles
from imutool.viewing.rerun.entities.names import Scope
from imutool.viewing.rerun.entities.palette import GROUND, MODEL_COLORS, RAW_FADE, Color, faded
from imutool.viewing.rerun.entities.paths import LEGEND_X, LEGEND_Y, error_rows, heat_top
from imutool.viewing.rerun.entities.plots import plot
from imutool.viewing.rerun.sdk import need_sdk

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

SHARES = {"paths": 6.0, "legend": 0.9, "error": 2.6}


def blueprint(logs: Sequence[RunData], *, source: bool = True) -> rrb.Blueprint:
    """The layout of what `scene.log` logs of the same logs with the same `source`; no empty panel.

    It opens at the end of the log, on `elapsed`, so that whole paths are seen.

    Raises:
        ConfigError: Rerun is not installed.
    """
    need_sdk()
    import rerun.blueprint as rrb

    scopes = names.scopes(logs)
    shown = [_of_one(data, scope, source) for data, scope in zip(logs, scopes, strict=True)]
    whole: Any = shown[0] if len(logs) == 1 else rrb.Tabs(_comparison(logs, scopes), *shown, active_tab=0)
    return rrb.Blueprint(
        whole,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=clock.ELAPSED, play_state="following"),
        auto_layout=False,
        auto_views=False,
    )


def _of_one(data: RunData, scope: Scope, source: bool) -> rrb.Horizontal:
    """One log: what it is about on the left, all the rest on the right."""
    import rerun.blueprint as rrb

    left: list[Any] = [paths_view(data, scope)]
    shares = [SHARES["paths"]]
    if heat_top(data) is not None:
        left.append(_legend(scope))
        shares.append(SHARES["legend"])
    curves = panels.total_errors(data, scope)
    left += curves
    shares += [SHARES["error"]] * len(curves)
    right = rrb.Tabs(*panels.tabs(data, scope, source), active_tab=0)
    return rrb.Horizontal(
        rrb.Vertical(*left, row_shares=shares), right, column_shares=[1, 1], name=scope[-1] if scope else None
    )


def paths_view(data: RunData, scope: Scope) -> rrb.Spatial3DView:
    """Paths up to the cursor on every timeline, and the bodies at it."""
    import rerun as rr
    import rerun.blueprint as rrb

    begin, cursor = rr.TimeRangeBoundary.infinite(), rr.TimeRangeBoundary.cursor_relative()
    homes = [names.of(data, trace, scope, "world", names.role(trace)) for trace in data.traces]
    homes += [names.path(scope, "world", "gt")] if data.truth is not None else []
    vectors = _error_vectors(data, scope)
    return rrb.Spatial3DView(
        origin=names.path(scope, "world"),
        contents=[*(f"{home}/**" for home in homes), *map(str, vectors)],
        overrides=vectors,
        name="Paths",
        background=GROUND,
        eye_controls=_eye(data),
        time_ranges=[rrb.VisibleTimeRange(timeline, start=begin, end=cursor) for timeline in clock.TIMELINES],
    )


def _error_vectors(data: RunData, scope: Scope) -> Mapping[rr.EntityPath | str, rrb.VisibleTimeRanges]:
    """Where each model's error vectors are, and that of those the one at the cursor is seen."""
    import rerun as rr
    import rerun.blueprint as rrb

    found: dict[rr.EntityPath | str, rrb.VisibleTimeRanges] = {}
    for trace in data.models():
        if trace.errors is not None and len(rows := error_rows(trace, trace.errors)) > 1:
            step_s = float(np.diff(trace.path.t_ns[rows]).max()) * 1e-9
            begin, cursor = (rr.TimeRangeBoundary.cursor_relative(seconds=s) for s in (-step_s, 0.0))
            ranges = [rrb.VisibleTimeRange(timeline, start=begin, end=cursor) for timeline in clock.TIMELINES]
            found[names.of(data, trace, scope, "world", "error_vec")] = rrb.VisibleTimeRanges(ranges)
    return found


def _legend(scope: Scope) -> rrb.Spatial2DView:
    """What the colours of the debiased path mean, in numbers."""
    import rerun.blueprint as rrb

    return rrb.Spatial2DView(
        origin=names.path(scope, "legend"),
        name="Orientation error of the debiased path",
        titlebar=False,
        background=GROUND,
        visual_bounds=rrb.VisualBounds2D(x_range=LEGEND_X, y_range=LEGEND_Y),
    )


def _comparison(logs: Sequence[RunData], scopes: Sequence[Scope]) -> rrb.Vertical:
    """The errors of all logs over elapsed time, and their figures side by side."""
    import rerun.blueprint as rrb

    rows: list[Any] = []
    scored = _scored(logs, scopes)
    for kind in errors.KINDS:
        overrides = {}
        for (data, trace, scope), color in zip(scored, _colors(scored), strict=True):
            name = f"{scope[-1]}: {names.label(data, trace)}"
            overrides[names.of(data, trace, scope, "error", kind, names.role(trace))] = styles.total(
                names.role(trace), name, color
            )
        if overrides:
            reach = max((panels.error_limit(data, kind) or 0.0 for data in logs), default=0.0)
            title = f"{kind.capitalize()} error ({errors.UNITS[kind]})"
            rows.append(plot(list(overrides), title, height=(0.0, reach) if reach else None, overrides=overrides))
    figures = rrb.TextDocumentView(origin="/compare", name="Figures")
    return rrb.Vertical(*([rrb.Horizontal(*rows)] if rows else []), figures, name="Compare")


def _scored(logs: Sequence[RunData], scopes: Sequence[Scope]) -> list[tuple[RunData, Trace, Scope]]:
    """Every run of every log that has errors."""
    return [
        (data, trace, scope)
        for data, scope in zip(logs, scopes, strict=True)
        for trace in data.traces
        if trace.errors is not None
    ]


def _colors(scored: Sequence[tuple[RunData, Trace, Scope]]) -> list[Color]:
    """A colour for each model of each log, told apart by colour-blind eyes while they last; raw has its log's, greyed."""
    models = [(scope, trace.name) for data, trace, scope in scored if not trace.is_raw or not data.models()]
    hues = MODEL_COLORS if len(models) <= len(MODEL_COLORS) else _circle(len(models))
    by_model = dict(zip(models, hues, strict=False))
    by_log = {scope: color for (scope, _), color in reversed(by_model.items())}
    return [by_model.get((scope, trace.name)) or faded(by_log[scope], RAW_FADE) for _, trace, scope in scored]


def _circle(count: int) -> list[Color]:
    """As many colours as that, as far from each other as they can be, all of about one brightness."""
    turns = [colorsys.hls_to_rgb((0.55 + k / count) % 1.0, 0.55, 0.65) for k in range(count)]
    return [(round(255 * red), round(255 * green), round(255 * blue)) for red, green, blue in turns]


def _eye(data: RunData) -> rrb.EyeControls3D:
    """A look at the truth (without it, at everything) from above one corner: raw paths often leave for kilometres."""
    import rerun.blueprint as rrb

    low, high = box(data)
    centre, size = (low + high) / 2.0, size_m(data)
    return rrb.EyeControls3D(position=centre + size * np.array([-0.7, -0.7, 0.5]), look_target=centre, eye_up=[0.0, 0.0, 1.0])


def box(data: RunData) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
    """The corners of what matters in 3D."""
    shown = [data.truth] if data.truth is not None else [trace.path for trace in data.traces]
    points = np.concatenate([poses.p_wb for poses in shown])
    return points.min(axis=0), points.max(axis=0)


def size_m(data: RunData) -> float:
    """The diagonal of what matters in 3D, at least a metre."""
    low, high = box(data)
    return max(float(np.linalg.norm(high - low)), 1.0)
