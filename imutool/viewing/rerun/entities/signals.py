"""Entities of samples, biases with three standard deviations, and spectra."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from imutool.array_types import Float64
from imutool.recording import Times
from imutool.units import AXES, SENSORS
from imutool.viewing.model.decimation import MAX_CURVE_ROWS, curve_rows
from imutool.viewing.model.run_data import RunData, Trace, gap_rows
from imutool.viewing.rerun import rr, sdk
from imutool.viewing.rerun.entities import styles
from imutool.viewing.rerun.entities.styles import BOLD_WIDTH, GRID, INK, RAW_FADE, XYZ, axis_colors, blend_to_grey
from imutool.viewing.rerun.sdk import Scope

SIGMAS = 3.0
MAX_DERIVED_ROWS = 50_000  # of a computed curve (four minutes at 200 Hz); samples keep up to MAX_CURVE_ROWS

WIDTH, HEIGHT = 200.0, 90.0  # of a spectrum's drawing, which the viewer scales as a whole
VISIBLE_X, VISIBLE_Y = (-24.0, WIDTH + 8.0), (-8.0, HEIGHT + 17.0)  # with room for tick labels
DECADE_SLACK = 0.02  # decades: 100.1 Hz need no decade of their own
MAX_POINTS = 400  # of a spectrum's curve: about two a pixel, the lowest and the highest of each bucket


def log_signals(data: RunData, to: rr.RecordingStream, scope: Scope) -> None:
    """Log the samples of every run, the biases of every model, and the true biases."""
    for trace in data.traces:
        _log_samples(data, to, scope, trace)
        if not trace.is_raw:
            _log_bias(data, to, scope, trace)
    for kind, bias in data.true_bias.items():
        log_curves(to, data, sdk.entity_path(scope, "bias", kind, "true"), bias.t_ns, bias.values, styles.true_bias_curves())


def _log_samples(data: RunData, to: rr.RecordingStream, scope: Scope, trace: Trace) -> None:
    imu, role = trace.run.imu, sdk.role(trace)
    for kind, values in zip(SENSORS, (imu.gyro, imu.accel), strict=True):
        entity = sdk.trace_path(data, trace, scope, "imu", kind, role)
        log_axes(to, data, trace, entity, imu.t_ns, values, max_rows=MAX_CURVE_ROWS)


def _log_bias(data: RunData, to: rr.RecordingStream, scope: Scope, trace: Trace) -> None:
    run, name, rank = trace.run, sdk.label(data, trace), model_index(data, trace)
    names = styles.axis_names("estimated" if name == "debiased" else name)
    for kind, bias, columns in zip(SENSORS, (run.gyro_bias, run.accel_bias), (slice(0, 3), slice(3, 6)), strict=True):
        entity = sdk.trace_path(data, trace, scope, "bias", kind)
        log_curves(to, data, f"{entity}/estimated", run.imu.t_ns, bias, styles.axis_curves("debiased", names, rank=rank))
        if run.bias_std is not None:
            margin = SIGMAS * run.bias_std[:, columns]
            band = np.hstack([bias + margin, bias - margin])
            log_curves(to, data, f"{entity}/sigma", run.imu.t_ns, band, styles.sigma_curves(rank))


def model_index(data: RunData, trace: Trace) -> int:
    """Position of a model among the models, from 0; 0 for raw."""
    return 0 if trace.is_raw else data.models().index(trace)


def log_axes(
    to: rr.RecordingStream,
    data: RunData,
    trace: Trace,
    entity: str,
    t_ns: Times,
    values: Float64[np.ndarray, "n 3"],
    axes: Sequence[str] = AXES,
    *,
    max_rows: int | None = None,
) -> None:
    """Log three curves of a run about or along x, y and z."""
    names = styles.axis_names(sdk.label(data, trace), axes)
    style = styles.axis_curves(sdk.role(trace), names, rank=model_index(data, trace), alone=not data.models())
    log_curves(to, data, entity, t_ns, values, style, max_rows=max_rows)


def log_curves(
    to: rr.RecordingStream,
    data: RunData,
    entity: str,
    t_ns: Times,
    values: Float64[np.ndarray, "n k"],
    style: rr.AsComponents,
    *,
    max_rows: int | None = None,
) -> None:
    """Log one curve per column after its style, decimated to `max_rows` (MAX_DERIVED_ROWS).

    A row of NaN in the middle of a gap breaks the line: Rerun's straight one would pass for samples.
    """
    rows, gaps = curve_rows(values, MAX_DERIVED_ROWS if max_rows is None else max_rows), gap_rows(t_ns)
    middle_ns, at = t_ns[gaps - 1] + (t_ns[gaps] - t_ns[gaps - 1]) // 2, np.searchsorted(rows, gaps)
    t_ns, values = np.insert(t_ns[rows], at, middle_ns), np.insert(values[rows], at, np.nan, axis=0)
    sdk.log_columns(to, entity, style, sdk.data_times(data, t_ns), rr.Scalars.columns(scalars=values))


def decimation_note(data: RunData) -> list[str]:
    """Sentence for the report where computed curves of this log are decimated."""
    if all(len(trace.run.imu) <= MAX_DERIVED_ROWS for trace in data.traces):
        return []
    return [f"Errors and biases are drawn with at most {MAX_DERIVED_ROWS:,} rows: the extremes of each stretch."]


@dataclass(frozen=True)
class DecadeFrame:
    """Whole decades of frequency (Hz) and root density that hold all curves of a drawing."""

    low_hz: int
    high_hz: int
    low: int
    high: int

    def at(self, hz: Float64[np.ndarray, " n"], root: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, "n 2"]:
        """Points of the drawing: right with frequency, up with density, clipped at the lower edge."""
        x = (np.log10(hz) - self.low_hz) / (self.high_hz - self.low_hz) * WIDTH
        y = (np.log10(np.maximum(root, 10.0**self.low)) - self.low) / (self.high - self.low) * HEIGHT
        return np.stack([x, HEIGHT - y], axis=1)


def log_spectra(data: RunData, to: rr.RecordingStream, scope: Scope) -> None:
    """Log `spectrum/{gyro,accel}/{frame,raw,debiased}` as drawings: Rerun plots over time alone."""
    for kind in sensors_with_spectrum(data):
        frame = decade_frame(data, kind)
        _log_frame(to, sdk.entity_path(scope, "spectrum", kind, "frame"), frame)
        for trace in data.traces:
            if kind in trace.spectra:
                entity = sdk.trace_path(data, trace, scope, "spectrum", kind, sdk.role(trace))
                _log_spectrum(data, to, entity, trace, kind, frame)


def sensors_with_spectrum(data: RunData) -> list[str]:
    """Sensors that have a spectrum."""
    return [kind for kind in SENSORS if any(kind in trace.spectra for trace in data.traces)]


def decade_frame(data: RunData, kind: str) -> DecadeFrame:
    """Decades that hold every curve, at most five below the highest: rounding fills the rest."""
    spectra = [trace.spectra[kind] for trace in data.traces if kind in trace.spectra]
    hz = np.concatenate([spectrum.frequency_hz for spectrum in spectra])
    root = np.sqrt(np.concatenate([spectrum.density.ravel() for spectrum in spectra]))
    root = root[root > 0.0]
    high = int(np.ceil(np.log10(root.max()))) if len(root) else 0
    low = max(int(np.floor(np.log10(root.min()))), high - 5) if len(root) else -1
    low_hz, high_hz = int(np.floor(np.log10(hz.min()))), int(np.ceil(np.log10(hz.max()) - DECADE_SLACK))
    return DecadeFrame(low_hz, max(high_hz, low_hz + 1), low, max(high, low + 1))


def decimate_points(points: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "m 2"]:
    """Decimate a curve to the lowest and the highest point of each column of the drawing."""
    edges = np.flatnonzero(np.diff(np.floor(points[:, 0] / WIDTH * MAX_POINTS / 2.0), prepend=-1.0))
    rows = {0, len(points) - 1}
    for first, last in zip(edges, [*edges[1:], len(points)], strict=True):
        height = points[first:last, 1]
        rows |= {int(first + height.argmin()), int(first + height.argmax())}
    return points[sorted(rows)]


def _log_spectrum(data: RunData, to: rr.RecordingStream, entity: str, trace: Trace, kind: str, frame: DecadeFrame) -> None:
    spectrum = trace.spectra[kind]
    strips = [decimate_points(frame.at(spectrum.frequency_hz, np.sqrt(column))) for column in spectrum.density.T]
    pale = trace.is_raw and bool(data.models())
    colors = [blend_to_grey(color, RAW_FADE) for color in XYZ] if pale else axis_colors(model_index(data, trace))
    radius = 0.9 * BOLD_WIDTH if pale else BOLD_WIDTH / 2.0  # where both curves agree, raw is the rim
    lines = rr.LineStrips2D(strips, colors=colors, radii=rr.Radius.ui_points(radius), draw_order=1.0 if pale else 2.0)
    sdk.log_static(to, entity, lines)


def _log_frame(to: rr.RecordingStream, entity: str, frame: DecadeFrame) -> None:
    """Lines at whole decades, with tick labels left and below."""
    across = np.arange(frame.low_hz, frame.high_hz + 1)
    up = np.arange(frame.low, frame.high + 1)
    x = (across - frame.low_hz) / (frame.high_hz - frame.low_hz) * WIDTH
    y = HEIGHT - (up - frame.low) / (frame.high - frame.low) * HEIGHT
    lines = [[[at, 0.0], [at, HEIGHT]] for at in x] + [[[0.0, at], [WIDTH, at]] for at in y]
    sdk.log_static(to, entity, rr.LineStrips2D(lines, colors=[GRID] * len(lines), radii=rr.Radius.ui_points(0.5)))
    _log_labels(to, f"{entity}/hz", [[at, HEIGHT + 4.0] for at in x], [f"{_power(power)} Hz" for power in across.tolist()])
    _log_labels(to, f"{entity}/density", [[-11.0, at - 5.5] for at in y], [_power(power) for power in up.tolist()])


def _log_labels(to: rr.RecordingStream, entity: str, positions: Sequence[Sequence[float]], labels: Sequence[str]) -> None:
    dots = rr.Radius.ui_points(0.0)
    text = rr.Points2D(positions, labels=list(labels), colors=[INK] * len(labels), radii=dots, show_labels=True)
    sdk.log_static(to, entity, text)


def _power(power: int) -> str:
    """Short text of a power of ten."""
    return f"{10.0**power:g}" if -2 <= power <= 3 else f"1e{power}"
