"""Viewer layouts of one log, of several logs, and of a live view."""

from __future__ import annotations

import colorsys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from imutool.viewing.model.run_data import RunData, Trace
from imutool.viewing.rerun import plots, rr, rrb, tabs
from imutool.viewing.rerun.entities import errors, styles
from imutool.viewing.rerun.entities.paths import LEGEND_X, LEGEND_Y, error_rows, error_scale_top
from imutool.viewing.rerun.entities.styles import BACKGROUND, MODEL_COLORS, RAW_FADE, Color, blend_to_grey
from imutool.viewing.rerun.plots import Box, plot
from imutool.viewing.rerun.sdk import Scope, entity_path, label, role, scopes, trace_path

ROW_SHARES = {"paths": 6.0, "legend": 0.9, "error": 2.6}
LIVE_WINDOW_S = 20.0  # of the plots in a live view


def blueprint(logs: Sequence[RunData], *, source: bool = True, root: Scope = ()) -> rrb.Blueprint:
    """Layout of what `scene.log` logs for the same arguments; every view has content.

    The cursor starts at the end of the log on `elapsed`, where whole paths are visible.

    Raises:
        ConfigError: Rerun is not installed.
    """
    of_logs = scopes(logs, root)
    views = [_log_view(data, scope, source) for data, scope in zip(logs, of_logs, strict=True)]
    return plots.frame(views[0] if len(logs) == 1 else rrb.Tabs(_comparison(logs, of_logs), *views, active_tab=0))


def live_blueprint(scopes: Mapping[str, Scope], boxes: Mapping[str, Box] | None = None) -> rrb.Blueprint:
    """Layout of a live view: paths next to signals and biases, a tab for each of several IMUs.

    Args:
        scopes: the scope of each IMU topic.
        boxes: the extent of each debiased path once it is complete; without them plots follow the last seconds.
    """
    views = [_live_view(topic, scope, None if boxes is None else boxes[topic]) for topic, scope in scopes.items()]
    return plots.frame(views[0] if len(views) == 1 else rrb.Tabs(*views, active_tab=0))


def fleet_blueprint() -> rrb.Blueprint:
    """Layout for any log of a fleet: paths and errors, and tabs of all else."""
    paths = rrb.Spatial3DView(
        origin="/world",
        contents=["/world/gt/**", "/world/debiased/**"],  # raw leaves for kilometres
        name="Paths",
        background=BACKGROUND,
        time_ranges=plots.visible_until_cursor(),
    )
    titles = {kind: f"{kind.capitalize()} error ({errors.UNITS[kind]})" for kind in errors.KINDS}
    own = [plot([f"/error/{kind}/debiased"], title, "debiased", legend=False) for kind, title in titles.items()]
    both = [
        plot([f"/error/{kind}/{role}" for role in ("raw", "debiased")], title, "raw orange, debiased blue")
        for kind, title in titles.items()
    ]
    axes = "x red, y green, z blue"
    signals = [
        plot([f"/imu/{kind}/{role}" for role in ("raw", "debiased")], title, f"{axes}; debiased bold, raw pale")
        for kind, title in tabs.TITLES.items()
    ]
    biases = [
        plot([f"/bias/{kind}/{of}" for of in ("sigma", "estimated", "true")], title, f"{axes}; ±3σ thin")
        for kind, title in tabs.BIAS_TITLES.items()
    ]
    lanes = rrb.StateTimelineView(origin="/events", name="When", time_view=plots.whole_time_axis())
    right = rrb.Tabs(
        rrb.Vertical(*signals, name="Signals"),
        rrb.Vertical(*biases, name="Bias"),
        rrb.Vertical(*both, name="Errors"),
        rrb.Vertical(lanes, rrb.TextLogView(origin="/events", name="What"), name="Events"),
        *(rrb.TextDocumentView(origin=f"/{name}", name=name.capitalize()) for name in ("report", "diagnosis")),
        active_tab=0,
    )
    left = rrb.Vertical(paths, *own, row_shares=[ROW_SHARES["paths"], *[ROW_SHARES["error"]] * len(own)])
    return plots.frame(rrb.Horizontal(left, right, column_shares=[1, 1]), recordings="expanded")


def _log_view(data: RunData, scope: Scope, source: bool) -> rrb.Horizontal:
    """One log: paths and total errors on the left, tabs on the right."""
    views: list[Any] = [paths_view(data, scope)]
    shares = [ROW_SHARES["paths"]]
    if error_scale_top(data) is not None:
        views.append(_legend(scope))
        shares.append(ROW_SHARES["legend"])
    curves = tabs.total_errors(data, scope)
    views += curves
    shares += [ROW_SHARES["error"]] * len(curves)
    right = rrb.Tabs(*tabs.tabs(data, scope, source), active_tab=0)
    return rrb.Horizontal(
        rrb.Vertical(*views, row_shares=shares), right, column_shares=[1, 1], name=scope[-1] if scope else None
    )


def paths_view(data: RunData, scope: Scope) -> rrb.Spatial3DView:
    """3D view of the paths up to the cursor and of the bodies at the cursor.

    The camera looks at the truth, without truth at all paths: raw paths often leave for kilometres.
    """
    entities = [trace_path(data, trace, scope, "world", role(trace)) for trace in data.traces]
    entities += [entity_path(scope, "world", "gt")] if data.truth is not None else []
    vectors = _error_vectors(data, scope)
    return rrb.Spatial3DView(
        origin=entity_path(scope, "world"),
        contents=[*(f"{entity}/**" for entity in entities), *map(str, vectors)],
        overrides=vectors,
        name="Paths",
        background=BACKGROUND,
        eye_controls=plots.camera_on(scene_box(data)),
        time_ranges=plots.visible_until_cursor(),
    )


def _error_vectors(data: RunData, scope: Scope) -> Mapping[rr.EntityPath | str, rrb.VisibleTimeRanges]:
    """Entity of each model's error vectors, of which only the one at the cursor is visible."""
    vectors: dict[rr.EntityPath | str, rrb.VisibleTimeRanges] = {}
    for trace in data.models():
        if trace.errors is not None and len(rows := error_rows(trace, trace.errors)) > 1:
            step_s = float(np.diff(trace.path.t_ns[rows]).max()) * 1e-9
            ranges = rrb.VisibleTimeRanges(plots.visible_until_cursor(step_s))
            vectors[trace_path(data, trace, scope, "world", "error_vec")] = ranges
    return vectors


def _legend(scope: Scope) -> rrb.Spatial2DView:
    """Colour scale of the debiased path."""
    return rrb.Spatial2DView(
        origin=entity_path(scope, "legend"),
        name="Orientation error of the debiased path",
        titlebar=False,
        background=BACKGROUND,
        visual_bounds=rrb.VisualBounds2D(x_range=LEGEND_X, y_range=LEGEND_Y),
    )


def _comparison(logs: Sequence[RunData], scopes: Sequence[Scope]) -> rrb.Vertical:
    """Errors of all logs over elapsed time, above a table of their figures."""
    rows: list[Any] = []
    with_scope = zip(logs, scopes, strict=True)
    scored = [(data, trace, scope) for data, scope in with_scope for trace in data.traces if trace.errors is not None]
    for kind in errors.KINDS:
        overrides = {}
        for (data, trace, scope), color in zip(scored, _comparison_colors(scored), strict=True):
            style = styles.total_error_curve(role(trace), f"{scope[-1]}: {label(data, trace)}", color)
            overrides[trace_path(data, trace, scope, "error", kind, role(trace))] = style
        if overrides:
            limit = max((tabs.error_limit(data, kind) or 0.0 for data in logs), default=0.0)
            title = f"{kind.capitalize()} error ({errors.UNITS[kind]})"
            rows.append(plot(list(overrides), title, height=(0.0, limit) if limit else None, overrides=overrides))
    figures = rrb.TextDocumentView(origin="/compare", name="Figures")
    return rrb.Vertical(*([rrb.Horizontal(*rows)] if rows else []), figures, name="Compare")


def _comparison_colors(scored: Sequence[tuple[RunData, Trace, Scope]]) -> list[Color]:
    """Colour of each run: colour-blind safe first for models; the log's colour, greyer, for raw."""
    models = [(scope, trace.name) for data, trace, scope in scored if not trace.is_raw or not data.models()]
    hues = MODEL_COLORS if len(models) <= len(MODEL_COLORS) else _color_wheel(len(models))
    by_model = dict(zip(models, hues, strict=False))
    by_log = {scope: color for (scope, _), color in reversed(by_model.items())}
    return [by_model.get((scope, trace.name)) or blend_to_grey(by_log[scope], RAW_FADE) for _, trace, scope in scored]


def _color_wheel(count: int) -> list[Color]:
    """Colours of equal lightness, evenly spaced in hue."""
    turns = [colorsys.hls_to_rgb((0.55 + k / count) % 1.0, 0.55, 0.65) for k in range(count)]
    return [(round(255 * red), round(255 * green), round(255 * blue)) for red, green, blue in turns]


def scene_box(data: RunData) -> Box:
    """Corners of the scene: of the true path, or of all paths without truth."""
    shown = [data.truth] if data.truth is not None else [trace.path for trace in data.traces]
    points = np.concatenate([poses.p_wb for poses in shown])
    return points.min(axis=0), points.max(axis=0)


def _live_view(topic: str, scope: Scope, box: Box | None) -> rrb.Horizontal:
    """Paths, signals and biases of one IMU; the camera follows the body until the box is known."""
    body = entity_path(scope, "world", "debiased", "body")
    paths = rrb.Spatial3DView(
        origin=entity_path(scope, "world"),
        name="Paths",
        background=BACKGROUND,
        # without truth, integration leaves for kilometres: while the path grows, the camera follows the body
        eye_controls=rrb.EyeControls3D(eye_up=(0.0, 0.0, 1.0), tracking_entity=body) if box is None else plots.camera_on(box),
        time_ranges=plots.visible_until_cursor(),
    )
    live = box is None
    signals = [_live_plot(scope, ("imu", kind), ("raw", "debiased"), title, live) for kind, title in tabs.TITLES.items()]
    biases = [
        _live_plot(scope, ("bias", kind), ("sigma", "estimated"), title, live) for kind, title in tabs.BIAS_TITLES.items()
    ]
    return rrb.Horizontal(paths, rrb.Vertical(*signals, *biases), column_shares=[1, 1], name=topic)


def _live_plot(scope: Scope, of: tuple[str, str], names: tuple[str, ...], title: str, live: bool) -> rrb.TimeSeriesView:
    contents = [entity_path(scope, *of, name) for name in names]
    if not live:
        return plot(contents, title, legend=False)
    ranges = plots.visible_until_cursor(LIVE_WINDOW_S)
    return rrb.TimeSeriesView(
        origin="/",
        contents=contents,
        name=title,
        plot_legend=rrb.PlotLegend(visible=False),
        axis_x=rrb.TimeAxis(link="Independent", view_range=ranges[0].range),
        time_ranges=ranges,
    )
