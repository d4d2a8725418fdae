"""Pictures of samples, biases, spectra and Allan deviations, by axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np

from imutool.array_types import Float64
from imutool.inertial import stationary
from imutool.noise import allan
from imutool.recording import Imu
from imutool.units import AXES, NOUNS, SENSORS, UNITS, Sensor
from imutool.viewing.html.drawing import Panel, Picture, at_least_three_ticks, decades, legend, plain_tick_labels
from imutool.viewing.html.page import AXIS_COLORS, INK, SOFT, TITLES
from imutool.viewing.html.report_errors import LINEAR_RATIO, name_off_scale
from imutool.viewing.html.report_paths import color_of, style_of
from imutool.viewing.html.report_wording import best_run, format_number, run_name, worst_orientation_error
from imutool.viewing.model.decimation import average_log_bins, decimate_extremes
from imutool.viewing.model.run_data import RunData, Spectrum, Trace, round_up_125, spectra

HEIGHT_INCH, SAMPLES_INCH = 4.2, 5.2
TAIL = 0.005  # of the samples: spikes may cross into the next run
SHIFTED = "Each run is drawn below the one before by the step at the right, so that it does not cover it."
ZOOM_S = 4.0
SIGMAS = 3.0
MARGIN = 0.15  # of a panel's height, above and below its curves
ROUNDING = 1e-7  # of the largest density: below is the rounding of a difference that is constant
BAND_POINTS = 300
MIN_REST_S = 4.0  # in one piece, for an Allan deviation

Vectors = Float64[np.ndarray, "_ 3"]
Values = Float64[np.ndarray, " _"]


def signals(data: RunData) -> Picture:
    """Raw and corrected samples by axis, decimated with their extremes."""
    return _samples(data, "signals", "Signals", "The decimation keeps every peak.", (0.0, data.duration_s))


def zoom(data: RunData) -> Picture | None:
    """Samples around the largest orientation error of the best model."""
    chosen = best_run(data)
    worst = None if chosen is None or chosen.is_raw else worst_orientation_error(chosen, data)
    if worst is None or data.duration_s <= 2.0 * ZOOM_S:
        return None
    assert chosen is not None, "a worst error belongs to a run"
    first = min(max(worst[1] - ZOOM_S / 2.0, 0.0), data.duration_s - ZOOM_S)
    caption = f"Every sample of {ZOOM_S:g} s around the largest orientation error of {run_name(chosen)}."
    return _samples(data, "zoom", "Signals where the error is largest", caption, (first, first + ZOOM_S))


def biases(data: RunData) -> Picture | None:
    """Bias of each model with three standard deviations where stated, and the true bias."""
    data = data.integrated()
    models = data.models()
    if not models:
        return None
    panels = [
        Panel(partial(_draw_bias, data=data, sensor=sensor), HEIGHT_INCH, f"{TITLES[sensor]} bias by axis")
        for sensor in SENSORS
    ]
    band = " Bands: three standard deviations, as the model states them." * any(t.run.bias_std is not None for t in models)
    true = " Dashed: the true bias." * bool(data.true_bias)
    return Picture("bias", "Biases", f"The bias that each model subtracts.{band}{true}", tuple(panels))


def spectrum(data: RunData) -> Picture | None:
    """Amplitude density of the samples up to half their rate; None for a short log."""
    data = data.integrated()
    curves = {
        sensor: [
            (trace, spectrum.frequency_hz, spectrum.density)
            for trace in data.traces
            if (spectrum := trace.spectra.get(sensor)) is not None and spectrum.density.any()  # a constant has none
        ]
        for sensor in SENSORS
    }
    if not any(curves.values()):
        return None
    removed = ((trace, Imu(trace.run.imu.t_ns, trace.run.gyro_bias, trace.run.accel_bias)) for trace in data.models())
    subtracted = [(trace, spectra(bias)) for trace, bias in removed]
    panels = [
        Panel(
            partial(_draw_spectrum, data=data, sensor=sensor, curves=curves[sensor], subtracted=subtracted),
            HEIGHT_INCH,
            f"{TITLES[sensor]} spectrum",
        )
        for sensor in SENSORS
        if curves[sensor]
    ]
    caption = "Amplitude density of the samples (Welch, one-sided), up to half their rate."
    caption += " White noise lies √2 above the noise density of imutool info --noise, which is two-sided."
    caption += " Dashed: the difference, raw minus debiased; it is small where the curves coincide." * bool(subtracted)
    return Picture("spectrum", "Spectra", caption, tuple(panels))


def allan_deviation(data: RunData) -> Picture | None:
    """Allan deviations at rest, raw and corrected.

    Nothing where it does not rest for long or reads a constant, or where allantools is not installed (`missing_pictures`).
    """
    if find_spec("allantools") is None:
        return None
    data = data.integrated()
    imu = data.traces[0].run.imu
    ranges = [(a, b) for a, b in stationary.rest_stretches(imu) if (imu.t_ns[b - 1] - imu.t_ns[a]) * 1e-9 >= MIN_REST_S]
    if not ranges:
        return None
    period_s = allan.sample_period_s(imu)
    rest_s = sum(b - a for a, b in ranges) * period_s
    curves: dict[str, list[Any]] = {sensor: [] for sensor in SENSORS}
    remarks: dict[Sensor, list[str]] = {}  # on what was recorded, the first trace
    for trace in data.traces:
        at_rest = [trace.run.imu.between(int(imu.t_ns[a]), int(imu.t_ns[b - 1])) for a, b in ranges]
        for sensor in SENSORS:
            still = [getattr(part, sensor) for part in at_rest]
            curve = allan.curve(still, period_s)
            curves[sensor].append((trace, curve.tau_s, curve.deviation))
            if sensor not in remarks:
                remarks[sensor] = allan.rest_remarks(sensor, allan.slopes(curve), allan.coarse_axes(still))
    panels = [
        Panel(
            partial(_draw_allan, data=data, sensor=sensor, curves=curves[sensor]),
            HEIGHT_INCH,
            f"{TITLES[sensor]} Allan deviation",
        )
        for sensor in SENSORS
        if any(deviation.any() for _, _, deviation in curves[sensor])  # a constant has none
    ]
    if not panels:
        return None
    caption = f"Over {format_number(rest_s)} s at rest in {len(ranges)} stretch{'es' * (len(ranges) > 1)}; overlapping."
    caption = " ".join([caption, *(f"{remark[0].upper()}{remark[1:]}." for sensor in SENSORS for remark in remarks[sensor])])
    return Picture("allan", "Allan deviation at rest", caption, tuple(panels))


def missing_pictures() -> list[str]:
    """Notes on pictures that need a package which is not installed."""
    if find_spec("allantools") is not None:
        return []
    return ["Without Allan deviations: allantools is not installed (pip install 'imutool[report]')."]


def _samples(data: RunData, name: str, title: str, caption: str, span_s: tuple[float, float]) -> Picture:
    data = data.integrated()
    panels = [
        Panel(partial(_draw_samples, data=data, sensor=sensor, span_s=span_s), SAMPLES_INCH, f"{NOUNS[sensor]} by axis")
        for sensor in SENSORS
    ]
    lower = f" {SHIFTED}" * (len(data.traces) > 1)
    return Picture(name, title, f"{caption}{lower}", tuple(panels))


def _by_axis(figure: Any, title: str, unit: str) -> list[Any]:
    """Three panels for x, y and z in their colours."""
    panels: list[Any] = list(figure.subplots(3, 1, sharex=True))
    for axis, axes in enumerate(panels):
        axes.set_ylabel(f"{AXES[axis]} ({unit})" if unit else AXES[axis], color=AXIS_COLORS[axis], fontweight="bold")
    panels[0].set_title(title)
    figure.align_ylabels(panels)
    return panels


def _draw_samples(figure: Any, *, data: RunData, sensor: str, span_s: tuple[float, float]) -> None:
    panels = _by_axis(figure, NOUNS[sensor], UNITS[sensor])
    lines, steps = [], np.zeros(3)
    for rank, trace in enumerate(data.traces):
        t = data.elapsed_s(trace.run.imu.t_ns)
        part = slice(*np.searchsorted(t, span_s, side="left") + np.array([0, 1]))
        values = getattr(trace.run.imu, sensor)[part]
        if rank == 0 and len(data.traces) > 1:
            steps = _steps(values)
        style = {"lw": 0.8, **style_of(data, trace)}
        drawn = [_line(axes, t[part], values[:, k] - rank * steps[k], trace.name, k, style) for k, axes in enumerate(panels)]
        lines.append(drawn[0])
    for axes, step in zip(panels, steps, strict=True):
        at_least_three_ticks(axes)
        if step > 0.0:
            axes.text(1.0, 1.0, f"step {step:g}", transform=axes.transAxes, ha="right", va="bottom", fontsize=8, color=SOFT)
    panels[-1].set(xlabel="time (s)", xlim=span_s)
    legend(figure, lines)


def _steps(values: Vectors) -> Values:
    """Distance between two runs that do not cover each other, by axis: rounded up to 1, 2 or 5 times a power of ten."""
    low, high = np.quantile(values, [TAIL, 1.0 - TAIL], axis=0) if len(values) else np.zeros((2, 3))
    return np.array([round_up_125(extent) if extent > 0.0 else 0.0 for extent in high - low])


def _draw_bias(figure: Any, *, data: RunData, sensor: str) -> None:
    panels = _by_axis(figure, f"{TITLES[sensor]} bias", UNITS[sensor])
    lines, bands = [], {}
    for trace in data.models():
        bias = trace.run.gyro_bias if sensor == "gyro" else trace.run.accel_bias
        t, color = data.elapsed_s(trace.run.imu.t_ns), color_of(data, trace)
        if trace.run.bias_std is not None:
            std = trace.run.bias_std[:, :3] if sensor == "gyro" else trace.run.bias_std[:, 3:]
            bands[trace.name] = _bands(panels, t, bias, SIGMAS * std, color)
        drawn = [
            _line(axes, t, bias[:, k], trace.name, k, {"lw": 1.3, **style_of(data, trace)}) for k, axes in enumerate(panels)
        ]
        lines.append(drawn[0])
    true = data.true_bias.get(sensor)
    if true is not None:
        t, style = data.elapsed_s(true.t_ns), {"color": INK, "lw": 1.3, "ls": (0, (4, 2))}
        drawn = [_line(axes, t, true.values[:, k], "true", k, style) for k, axes in enumerate(panels)]
        lines.append(drawn[0])
    for axis, axes in enumerate(panels):
        axes.margins(y=MARGIN)
        _leave_out_wide(axes, {name: edges[axis] for name, edges in bands.items()})
        at_least_three_ticks(axes)
    panels[-1].set(xlabel="time (s)", xlim=(0.0, data.duration_s))
    legend(figure, lines)


def _bands(panels: Sequence[Any], t: Values, bias: Vectors, half: Vectors, color: str) -> Float64[np.ndarray, "3 2"]:
    """Three standard deviations about each axis, per pixel from the lowest to the highest; returns the ends by axis."""
    starts = np.unique(np.linspace(0, len(t) - 1, BAND_POINTS).astype(int))
    low, high = np.minimum.reduceat(bias - half, starts), np.maximum.reduceat(bias + half, starts)
    for k, axes in enumerate(panels):
        axes.fill_between(t[starts], low[:, k], high[:, k], color=color, alpha=0.22, lw=0, label=f"±3 σ, {AXES[k]}")
    return np.stack([low.min(axis=0), high.max(axis=0)], axis=1)


def _leave_out_wide(axes: Any, bands: Mapping[str, Values]) -> None:
    """Limits by the curves and the narrow bands, where a wide one would make them one line."""
    widths = {name: float(np.ptp(ends)) for name, ends in bands.items()}
    wide = [name for name, width in widths.items() if width > LINEAR_RATIO * min(widths.values()) > 0.0]
    if wide:
        shown = [line.get_ydata() for line in axes.lines] + [ends for name, ends in bands.items() if name not in wide]
        low, high = np.nanmin(np.concatenate(shown)), np.nanmax(np.concatenate(shown))
        axes.set_ylim(low - MARGIN * (high - low), high + MARGIN * (high - low))
    name_off_scale(axes, [f"±3 σ of {name}, {format_number(widths[name])} wide" for name in wide])


def _draw_spectrum(
    figure: Any,
    *,
    data: RunData,
    sensor: str,
    curves: Sequence[Any],
    subtracted: Sequence[tuple[Trace, Mapping[str, Spectrum]]],
) -> None:
    panels = _by_axis(figure, f"{NOUNS[sensor]} ({UNITS[sensor]}/√Hz, one-sided)", "")
    lines = []
    for trace, frequency_hz, density in curves:
        at, power = average_log_bins(frequency_hz, density, frequency_hz[0])
        drawn = [_log_line(axes, at, np.sqrt(power[:, k]), data, trace, k) for k, axes in enumerate(panels)]
        lines.append(drawn[0])
    for trace, densities in subtracted:
        density, style = densities[sensor].density, {"color": color_of(data, trace), "lw": 1.0, "ls": (0, (4, 2))}
        at, power = average_log_bins(densities[sensor].frequency_hz, density, densities[sensor].frequency_hz[0])
        for k, axes in enumerate(panels):
            label = f"{run_name(trace)}: raw minus debiased, {AXES[k]}"
            axes.plot(at, np.sqrt(np.where(power[:, k] > 0.0, power[:, k], np.nan)), label=label, **style)
    for k, axes in enumerate(panels):
        powers = [density[:, k] for _, _, density in curves]
        largest = max(float(np.sqrt(power.max(where=np.isfinite(power), initial=0.0))) for power in powers)
        if largest > 0.0:
            axes.set_yscale("log")
            axes.set_ylim(bottom=max(axes.get_ylim()[0], ROUNDING * largest))
    _decades(panels)
    panels[-1].set_xlabel("frequency (Hz)")
    legend(figure, lines)


def _draw_allan(figure: Any, *, data: RunData, sensor: str, curves: Sequence[Any]) -> None:
    panels = _by_axis(figure, f"{TITLES[sensor]}: Allan deviation", UNITS[sensor])
    lines = []
    for trace, tau_s, deviation in curves:
        drawn = [_log_line(axes, tau_s, deviation[:, k], data, trace, k) for k, axes in enumerate(panels)]
        lines.append(drawn[0])
    _decades(panels)
    panels[-1].set_xlabel("averaging time (s)")
    legend(figure, lines)


def _line(axes: Any, t: Any, y: Any, name: str, axis: int, style: Mapping[str, Any]) -> Any:
    return axes.plot(*decimate_extremes(t, y), label=name if axis == 0 else f"{name}, {AXES[axis]}", **style)[0]


def _log_line(axes: Any, x: Any, y: Any, data: RunData, trace: Trace, axis: int) -> Any:
    name = trace.name if axis == 0 else f"{trace.name}, {AXES[axis]}"
    shown = np.where(y > 0.0, y, np.nan)  # a constant has no spectrum
    under = trace.is_raw and bool(data.models())
    style = {"lw": 1.8 if under else 1.0, "alpha": 0.55 if under else 1.0, **style_of(data, trace)}
    return axes.plot(x, shown, label=name, **style)[0]


def _decades(panels: Sequence[Any]) -> None:
    """Logarithmic axes with limits at whole decades, so that every panel has tick labels."""
    for axes in panels:
        axes.set_xscale("log")
        axes.set_yscale("log")
        decades(axes)
        plain_tick_labels(axes.xaxis, axes.yaxis)
