"""The tabs beside the paths: signals, biases, spectra, errors in detail, events, report and cameras; none without content."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from imutool.units import AXES, UNITS
from imutool.viewing.model.run_data import RunData, Trace
from imutool.viewing.model.trajectory_error import Drift, Errors
from imutool.viewing.rerun import source
from imutool.viewing.rerun.entities import errors, events, signals, spectrum
from imutool.viewing.rerun.entities import names as entities
from imutool.viewing.rerun.entities.names import Scope
from imutool.viewing.rerun.entities.palette import GROUND, color_name, color_of
from imutool.viewing.rerun.entities.plots import both_ways, limit, plot, upwards, whole

if TYPE_CHECKING:
    import rerun.blueprint as rrb

TITLES = {"gyro": "Angular rate (rad/s)", "accel": "Specific force (m/s²)"}
BIAS_TITLES = {"gyro": "Gyro bias (rad/s)", "accel": "Accel bias (m/s²)"}
SPECTRUM_TITLES = {
    "gyro": "Angular rate: root of density (rad/s/√Hz) over frequency",
    "accel": "Specific force: root of density (m/s²/√Hz) over frequency",
}
SHOWN_SIGMA = 90.0  # percent of the log for which three standard deviations fit into a plot of biases
AROUND = 0.15  # of its height is left free above and below
Panel = Any  # a view or a container of views


def tabs(data: RunData, scope: Scope, with_source: bool) -> list[Panel]:
    """Everything but paths and total errors, in the order of the tabs."""
    found = [_signals(data, scope), _bias(data, scope), _spectrum(data, scope), _errors(data, scope), _events(data, scope)]
    return [panel for panel in (*found, _report(scope), _cameras(data, scope) if with_source else None) if panel is not None]


def total_errors(data: RunData, scope: Scope) -> list[Panel]:
    """Orientation and position error of every run, with a model's worst moment; nothing without truth."""
    found = []
    for kind in errors.KINDS:
        scored = [trace for trace in data.traces if trace.errors is not None]
        contents = [entities.of(data, trace, scope, "error", kind, entities.role(trace)) for trace in scored]
        contents += [f"{path}/worst" for path, trace in zip(contents, scored, strict=True) if not trace.is_raw]
        if contents:
            reach = error_limit(data, kind)
            top = "" if reach is None else f", top {reach:.3g}"  # a low plot may have no room for its axis to say it
            title, key = f"{kind.capitalize()} error ({errors.UNITS[kind]}){top}", _colors(data, _models_first(data))
            key += ", worst pink" if any(not trace.is_raw for trace in scored) else ""
            found.append(plot(contents, title, key, height=upwards(reach)))
    return found


def _colors(data: RunData, of: Sequence[Trace]) -> str:
    """Which colour stands for which run: said in titles, because a legend would cover curves."""
    return ", ".join(f"{entities.label(data, trace)} {color_name(data, trace)}" for trace in of)


def _models_first(data: RunData) -> list[Trace]:
    return [*data.models(), *(trace for trace in data.traces if trace.is_raw)]


def error_limit(data: RunData, kind: str) -> float | None:
    """How high the plot of total errors of one kind reaches."""
    return limit(data, _by_run(data, lambda found: errors.total(found, kind)))


def _signals(data: RunData, scope: Scope) -> Panel:
    import rerun.blueprint as rrb

    shown = [_three(data, _of_all(data, scope, "imu", kind), title) for kind, title in TITLES.items()]
    return rrb.Vertical(*shown, name="Signals")


def _bias(data: RunData, scope: Scope) -> Panel | None:
    """A tab for each sensor, a plot for each axis: beside offsets of a tenth, differences of a thousandth are lost."""
    import rerun.blueprint as rrb

    sensors = [kind for kind in signals.KINDS if data.models() or kind in data.true_bias]
    if not sensors:
        return None
    found = [
        rrb.Vertical(*(_bias_of(data, scope, kind, axis) for axis in range(3)), name=BIAS_TITLES[kind]) for kind in sensors
    ]
    return rrb.Tabs(*found, active_tab=0, name="Bias")


def _bias_of(data: RunData, scope: Scope, kind: str, axis: int) -> rrb.TimeSeriesView:
    """One axis of one sensor; of several models each in its own colour, as in the plots of errors."""
    import rerun as rr

    overrides: dict[str, Any] = {}
    several = len(data.models()) > 1
    words = []
    if kind in data.true_bias:
        overrides[entities.path(scope, "bias", kind, "true")] = rr.SeriesLines(visible_series=_only(axis, 3))
        words.append("true broad and pale")
    for trace in data.models():
        home = entities.of(data, trace, scope, "bias", kind)
        colors = [color_of(data, trace)] if several else None
        overrides[f"{home}/estimated"] = rr.SeriesLines(visible_series=_only(axis, 3), colors=colors and colors * 3)
        if trace.run.bias_std is not None:
            overrides[f"{home}/sigma"] = rr.SeriesLines(visible_series=_only(axis, 6), colors=colors and colors * 6)
    if data.models():
        words.insert(0, "estimated bold")
    if any(trace.run.bias_std is not None for trace in data.models()):
        words.insert(1, f"±{signals.SIGMAS:g}σ thin")
    key = ", ".join([*words, *([_colors(data, data.models())] if several else [])])
    return plot(
        list(overrides), f"{AXES[axis]} ({UNITS[kind]})", key, height=_bias_range(data, kind, axis), overrides=overrides
    )


def _only(axis: int, count: int) -> list[bool]:
    return [column % 3 == axis for column in range(count)]


def _bias_range(data: RunData, kind: str, axis: int) -> tuple[float, float] | None:
    """Room for estimates, truth and most of the log's standard deviations: at the start they may be many times larger."""
    lows, highs = [], []
    for trace in data.models():
        bias = (trace.run.gyro_bias if kind == "gyro" else trace.run.accel_bias)[:, axis]
        spread = 0.0
        if trace.run.bias_std is not None:
            spread = signals.SIGMAS * float(np.percentile(trace.run.bias_std[:, axis + 3 * (kind == "accel")], SHOWN_SIGMA))
        lows += [float(bias.min()), float(np.median(bias)) - spread]
        highs += [float(bias.max()), float(np.median(bias)) + spread]
    if kind in data.true_bias and len(true := data.true_bias[kind].values[:, axis]):
        lows.append(float(np.nanmin(true)))
        highs.append(float(np.nanmax(true)))
    if not lows or not np.isfinite([min(lows), max(highs)]).all() or max(highs) <= min(lows):
        return None
    free = AROUND * (max(highs) - min(lows))
    return min(lows) - free, max(highs) + free


def _spectrum(data: RunData, scope: Scope) -> Panel | None:
    import rerun.blueprint as rrb

    bounds = rrb.VisualBounds2D(x_range=spectrum.SHOWN_X, y_range=spectrum.SHOWN_Y)
    shown = []
    for kind in spectrum.kinds(data):
        home = entities.path(scope, "spectrum", kind)
        contents = [f"{home}/**", *_of_all(data, scope, "spectrum", kind)]
        title = SPECTRUM_TITLES[kind]
        shown.append(rrb.Spatial2DView(origin=home, contents=contents, name=title, background=GROUND, visual_bounds=bounds))
    return rrb.Vertical(*shown, name="Spectrum") if shown else None


def _errors(data: RunData, scope: Scope) -> Panel | None:
    """By axis, by angle or direction, and since the last reset; a tab for orientation and one for position."""
    import rerun.blueprint as rrb

    if all(trace.errors is None for trace in data.traces):
        return None
    return rrb.Tabs(
        rrb.Vertical(*_orientation(data, scope), name="Orientation (deg)"),
        rrb.Vertical(*_position(data, scope), name="Position (m)"),
        active_tab=0,
        name="Errors",
    )


def _orientation(data: RunData, scope: Scope) -> list[Panel]:
    by_axis = limit(data, _by_run(data, lambda found: found.orientation_deg))
    by_angle = limit(data, _by_run(data, lambda found: found.roll_pitch_yaw_deg))
    return [
        _three(data, _of_scored(data, scope, "orientation", "axes"), "About the body's axes (deg)", both_ways(by_axis)),
        _three(
            data, _of_scored(data, scope, "orientation", "rpy"), "Roll, pitch, yaw (deg)", both_ways(by_angle), errors.ANGLES
        ),
        *_drift(data, scope, "orientation", lambda drift: drift.orientation_deg),
    ]


def _position(data: RunData, scope: Scope) -> list[Panel]:
    by_axis = limit(data, _by_run(data, lambda found: found.position_m))
    contents = [*_of_scored(data, scope, "position", "horizontal"), *_of_scored(data, scope, "position", "vertical")]
    reach = both_ways(error_limit(data, "position"))
    return [
        _three(data, _of_scored(data, scope, "position", "axes"), "Along the world's axes (m)", both_ways(by_axis)),
        plot(contents, "Horizontal (length) and vertical (m)", height=reach),
        *_drift(data, scope, "position", lambda drift: drift.position_m),
    ]


def _drift(data: RunData, scope: Scope, kind: str, of: Callable[[Drift], np.ndarray]) -> list[Panel]:
    """Nothing where there is none."""
    drifts = {trace.name: trace.drift for trace in data.traces if trace.drift is not None}
    if not drifts:
        return []
    drifted = [trace for trace in data.traces if trace.name in drifts]
    contents = [entities.of(data, trace, scope, "error", "drift", kind, entities.role(trace)) for trace in drifted]
    reset_s = next(iter(drifts.values())).reset_s
    title, key = f"Since the last reset, every {reset_s:g} s ({errors.UNITS[kind]})", _colors(data, _models_first(data))
    return [plot(contents, title, key, height=upwards(limit(data, {name: of(drift) for name, drift in drifts.items()})))]


def _events(data: RunData, scope: Scope) -> Panel | None:
    import rerun.blueprint as rrb

    kinds = events.kinds(data)
    if not kinds:
        return None
    contents = [entities.path(scope, "events", kind) for kind in kinds]
    lanes = rrb.StateTimelineView(origin=entities.path(scope, "events"), contents=contents, name="When", time_view=whole())
    return rrb.Vertical(lanes, _event_list(contents, entities.path(scope, "events")), name="Events", row_shares=[1, 1])


def _event_list(contents: list[str], origin: str) -> rrb.TextLogView:
    """Time, level and words; a click on a time takes the cursor there."""
    import rerun.blueprint as rrb

    columns = rrb.TextLogColumns(text_log_columns=["loglevel", "body"])
    return rrb.TextLogView(origin=origin, contents=contents, name="What", columns=columns)


def _report(scope: Scope) -> Panel:
    import rerun.blueprint as rrb

    return rrb.TextDocumentView(origin=entities.path(scope, "report"), name="Report")


def _cameras(data: RunData, scope: Scope) -> Panel | None:
    import rerun.blueprint as rrb

    cameras = source.plan(data, scope).cameras
    shown = [rrb.Spatial2DView(origin=camera, name=camera.removeprefix("/")) for camera in cameras]
    return rrb.Grid(*shown, name="Cameras") if shown else None


def _three(
    data: RunData,
    contents: list[str],
    title: str,
    height: tuple[float, float] | None = None,
    names: tuple[str, ...] = AXES,
) -> rrb.TimeSeriesView:
    """A plot of curves about or along x, y and z, with their colours in the title: a legend of six lines would cover them."""
    key = ", ".join(f"{name} {color}" for name, color in zip(names, ("red", "green", "blue"), strict=True))
    models = [entities.label(data, trace) for trace in data.models()]
    if len(models) == 1:
        key += f"; {models[0]} bold{', raw faint' if len(data.traces) > 1 else ''}"
    elif models:
        key += f"; {models[0]} bold, {', '.join(f'{name} paler' for name in models[1:])}"
    return plot(contents, title, key, height=height)


def _by_run(data: RunData, of: Callable[[Errors], np.ndarray]) -> dict[str, np.ndarray]:
    """One kind of error of each run that has errors."""
    return {trace.name: of(trace.errors) for trace in data.traces if trace.errors is not None}


def _of_all(data: RunData, scope: Scope, *parts: str) -> list[str]:
    """One entity of each run."""
    return [entities.of(data, trace, scope, *parts, entities.role(trace)) for trace in data.traces]


def _of_scored(data: RunData, scope: Scope, kind: str, part: str) -> list[str]:
    """One entity of each run that has errors."""
    scored = [trace for trace in data.traces if trace.errors is not None]
    return [entities.of(data, trace, scope, "error", kind, entities.role(trace), part) for trace in scored]
