"""Tabs of a layout: signals, biases, spectra, errors, events, report and cameras."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from imutool.units import AXES, NOUNS, SENSORS, UNITS
from imutool.viewing.model.run_data import RunData, Trace
from imutool.viewing.model.trajectory_error import Drift, Errors
from imutool.viewing.rerun import other_topics, rr, rrb, sdk
from imutool.viewing.rerun.entities import errors, signals
from imutool.viewing.rerun.entities.styles import BACKGROUND, color_name, color_of
from imutool.viewing.rerun.plots import error_axis_limit, error_range, plot, whole_time_axis
from imutool.viewing.rerun.sdk import Scope

TITLES = {sensor: f"{NOUNS[sensor]} ({UNITS[sensor]})" for sensor in SENSORS}
BIAS_TITLES = {"gyro": "Gyro bias (rad/s)", "accel": "Accel bias (m/s²)"}
SPECTRUM_TITLES = {
    "gyro": "Angular rate: root of one-sided density (rad/s/√Hz) over frequency",
    "accel": "Specific force: root of one-sided density (m/s²/√Hz) over frequency",
}
SIGMA_PERCENTILE = 90.0  # share of the log for which three standard deviations fit into a plot of biases, %
MARGIN = 0.15  # of its range, free above and below the curves of a plot
View = Any  # a view or a container of views


def tabs(data: RunData, scope: Scope, with_source: bool) -> list[View]:
    """Tabs with content, in their order."""
    samples = data.integrated()
    views = [_signals(samples, scope), _bias(samples, scope), _spectrum(samples, scope), _errors(data, scope)]
    views.append(_events(data, scope))
    report = rrb.TextDocumentView(origin=sdk.entity_path(scope, "report"), name="Report")
    return [view for view in (*views, report, _cameras(data, scope) if with_source else None) if view is not None]


def total_errors(data: RunData, scope: Scope) -> list[View]:
    """Plots of the total errors of every run, with the worst moment of each model."""
    views = []
    for kind in errors.KINDS:
        scored = [trace for trace in data.traces if trace.errors is not None]
        contents = [sdk.trace_path(data, trace, scope, "error", kind, sdk.role(trace)) for trace in scored]
        contents += [f"{path}/worst" for path, trace in zip(contents, scored, strict=True) if not trace.is_raw]
        if contents:
            limit = error_limit(data, kind)
            top = "" if limit is None else f", top {limit:.3g}"  # a low plot may have no room for tick labels
            title, key = f"{kind.capitalize()} error ({errors.UNITS[kind]}){top}", _colors(data, _models_first(data))
            key += ", worst pink" if any(not trace.is_raw for trace in scored) else ""
            views.append(plot(contents, title, key, height=error_range(limit)))
    return views


def _colors(data: RunData, of: Sequence[Trace]) -> str:
    """Colour of each run, for titles: a legend would cover curves."""
    return ", ".join(f"{sdk.label(data, trace)} {color_name(data, trace)}" for trace in of)


def _models_first(data: RunData) -> list[Trace]:
    return [*data.models(), *(trace for trace in data.traces if trace.is_raw)]


def error_limit(data: RunData, kind: str) -> float | None:
    """Upper limit of the plot of total errors of one kind."""
    return error_axis_limit(data, _by_run(data, lambda errors_of_run: errors.total_error(errors_of_run, kind)))


def _signals(data: RunData, scope: Scope) -> View:
    shown = [_three(data, _of_all(data, scope, "imu", kind), title) for kind, title in TITLES.items()]
    return rrb.Vertical(*shown, name="Signals")


def _bias(data: RunData, scope: Scope) -> View | None:
    """Bias tabs per sensor, a plot per axis: one plot would hide differences of a thousandth."""
    sensors = [kind for kind in SENSORS if data.models() or kind in data.true_bias]
    if not sensors:
        return None
    views = [
        rrb.Vertical(*(_bias_of(data, scope, kind, axis) for axis in range(3)), name=BIAS_TITLES[kind]) for kind in sensors
    ]
    return rrb.Tabs(*views, active_tab=0, name="Bias")


def _bias_of(data: RunData, scope: Scope, kind: str, axis: int) -> rrb.TimeSeriesView:
    """Plot of one axis of one sensor; each of several models has its colour of the error plots."""
    overrides: dict[str, Any] = {}
    several = len(data.models()) > 1
    key_parts = []
    if kind in data.true_bias:
        overrides[sdk.entity_path(scope, "bias", kind, "true")] = rr.SeriesLines(visible_series=_only(axis, 3))
        key_parts.append("true broad and pale")
    for trace in data.models():
        home = sdk.trace_path(data, trace, scope, "bias", kind)
        colors = [color_of(data, trace)] if several else None
        overrides[f"{home}/estimated"] = rr.SeriesLines(visible_series=_only(axis, 3), colors=colors and colors * 3)
        if trace.run.bias_std is not None:
            overrides[f"{home}/sigma"] = rr.SeriesLines(visible_series=_only(axis, 6), colors=colors and colors * 6)
    if data.models():
        key_parts.insert(0, "estimated bold")
    if any(trace.run.bias_std is not None for trace in data.models()):
        key_parts.insert(1, f"±{signals.SIGMAS:g}σ thin")
    key = ", ".join([*key_parts, *([_colors(data, data.models())] if several else [])])
    return plot(
        list(overrides), f"{AXES[axis]} ({UNITS[kind]})", key, height=_bias_range(data, kind, axis), overrides=overrides
    )


def _only(axis: int, count: int) -> list[bool]:
    return [column % 3 == axis for column in range(count)]


def _bias_range(data: RunData, kind: str, axis: int) -> tuple[float, float] | None:
    """Axis range of estimates, truth and most sigmas, which may be far larger at the start."""
    lows, highs = [], []
    for trace in data.models():
        bias = (trace.run.gyro_bias if kind == "gyro" else trace.run.accel_bias)[:, axis]
        spread = 0.0
        if trace.run.bias_std is not None:
            spread = signals.SIGMAS * float(
                np.percentile(trace.run.bias_std[:, axis + 3 * (kind == "accel")], SIGMA_PERCENTILE)
            )
        lows += [float(bias.min()), float(np.median(bias)) - spread]
        highs += [float(bias.max()), float(np.median(bias)) + spread]
    if kind in data.true_bias and len(true := data.true_bias[kind].values[:, axis]):
        lows.append(float(np.nanmin(true)))
        highs.append(float(np.nanmax(true)))
    if not lows or not np.isfinite([min(lows), max(highs)]).all() or max(highs) <= min(lows):
        return None
    margin = MARGIN * (max(highs) - min(lows))
    return min(lows) - margin, max(highs) + margin


def _spectrum(data: RunData, scope: Scope) -> View | None:
    bounds = rrb.VisualBounds2D(x_range=signals.VISIBLE_X, y_range=signals.VISIBLE_Y)
    shown = []
    for kind in signals.sensors_with_spectrum(data):
        home = sdk.entity_path(scope, "spectrum", kind)
        contents = [f"{home}/**", *_of_all(data, scope, "spectrum", kind)]
        title = SPECTRUM_TITLES[kind]
        shown.append(rrb.Spatial2DView(origin=home, contents=contents, name=title, background=BACKGROUND, visual_bounds=bounds))
    return rrb.Vertical(*shown, name="Spectrum") if shown else None


def _errors(data: RunData, scope: Scope) -> View | None:
    """Errors by axis, by angle or direction, and since the last reset; one tab per kind."""
    if all(trace.errors is None for trace in data.traces):
        return None
    return rrb.Tabs(
        rrb.Vertical(*_orientation(data, scope), name="Orientation (deg)"),
        rrb.Vertical(*_position(data, scope), name="Position (m)"),
        active_tab=0,
        name="Errors",
    )


def _orientation(data: RunData, scope: Scope) -> list[View]:
    by_axis = error_range(error_axis_limit(data, _by_run(data, lambda found: found.orientation_deg)), signed=True)
    by_angle = error_range(error_axis_limit(data, _by_run(data, lambda found: found.roll_pitch_yaw_deg)), signed=True)
    return [
        _three(data, _of_scored(data, scope, "orientation", "axes"), "About the body's axes (deg)", by_axis),
        _three(data, _of_scored(data, scope, "orientation", "rpy"), "Roll, pitch, yaw (deg)", by_angle, errors.ANGLES),
        *_drift(data, scope, "orientation", lambda drift: drift.orientation_deg),
    ]


def _position(data: RunData, scope: Scope) -> list[View]:
    by_axis = error_range(error_axis_limit(data, _by_run(data, lambda found: found.position_m)), signed=True)
    contents = [*_of_scored(data, scope, "position", "horizontal"), *_of_scored(data, scope, "position", "vertical")]
    limits = error_range(error_limit(data, "position"), signed=True)
    return [
        _three(data, _of_scored(data, scope, "position", "axes"), "Along the world's axes (m)", by_axis),
        plot(contents, "Horizontal (length) and vertical (m)", height=limits),
        *_drift(data, scope, "position", lambda drift: drift.position_m),
    ]


def _drift(data: RunData, scope: Scope, kind: str, of: Callable[[Drift], np.ndarray]) -> list[View]:
    """Plot of the drift since the last reset, if there is any."""
    drifts = {trace.name: trace.drift for trace in data.traces if trace.drift is not None}
    if not drifts:
        return []
    drifted = [trace for trace in data.traces if trace.name in drifts]
    contents = [sdk.trace_path(data, trace, scope, "error", "drift", kind, sdk.role(trace)) for trace in drifted]
    reset_s = next(iter(drifts.values())).reset_s
    title, key = f"Since the last reset, every {reset_s:g} s ({errors.UNITS[kind]})", _colors(data, _models_first(data))
    return [
        plot(
            contents,
            title,
            key,
            height=error_range(error_axis_limit(data, {name: of(drift) for name, drift in drifts.items()})),
        )
    ]


def _events(data: RunData, scope: Scope) -> View | None:
    kinds = errors.event_kinds(data)
    if not kinds:
        return None
    origin, contents = sdk.entity_path(scope, "events"), [sdk.entity_path(scope, "events", kind) for kind in kinds]
    lanes = rrb.StateTimelineView(origin=origin, contents=contents, name="When", time_view=whole_time_axis())
    columns = rrb.TextLogColumns(text_log_columns=["loglevel", "body"])
    texts = rrb.TextLogView(origin=origin, contents=contents, name="What", columns=columns)  # a click moves the cursor there
    return rrb.Vertical(lanes, texts, name="Events", row_shares=[1, 1])


def _cameras(data: RunData, scope: Scope) -> View | None:
    cameras = other_topics.plan_import(data, scope).cameras
    shown = [rrb.Spatial2DView(origin=camera, name=camera.removeprefix("/")) for camera in cameras]
    return rrb.Grid(*shown, name="Cameras") if shown else None


def _three(
    data: RunData, contents: list[str], title: str, height: tuple[float, float] | None = None, names: tuple[str, ...] = AXES
) -> rrb.TimeSeriesView:
    """Plot of x, y and z curves; colours in the title instead of a legend of six lines."""
    key = ", ".join(f"{name} {color}" for name, color in zip(names, ("red", "green", "blue"), strict=True))
    models = [sdk.label(data, trace) for trace in data.models()]
    if len(models) == 1:
        key += f"; {models[0]} bold{', raw pale' if len(data.traces) > 1 else ''}"
    elif models:
        key += f"; {models[0]} bold, {', '.join(f'{name} paler' for name in models[1:])}"
    return plot(contents, title, key, height=height)


def _by_run(data: RunData, of: Callable[[Errors], np.ndarray]) -> dict[str, np.ndarray]:
    """One kind of error of each run that has errors."""
    return {trace.name: of(trace.errors) for trace in data.traces if trace.errors is not None}


def _of_all(data: RunData, scope: Scope, *parts: str) -> list[str]:
    """Path of one entity of each run."""
    return [sdk.trace_path(data, trace, scope, *parts, sdk.role(trace)) for trace in data.traces]


def _of_scored(data: RunData, scope: Scope, kind: str, part: str) -> list[str]:
    """Path of one error entity of each run that has errors."""
    scored = [trace for trace in data.traces if trace.errors is not None]
    return [sdk.trace_path(data, trace, scope, "error", kind, sdk.role(trace), part) for trace in scored]
