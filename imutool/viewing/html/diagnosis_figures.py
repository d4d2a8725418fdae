"""Figures of a diagnosis as inline SVG: location of the misfit, residuals, spectra, trends.

Colours are variables of the page's style sheet, so that one drawing serves light, dark and print.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.signal import fftconvolve, welch
from scipy.spatial.transform import Rotation

from imutool.array_types import Bool, Float64
from imutool.diagnosis.estimation.whitening import Band
from imutool.diagnosis.result import Curve, Diagnosis, Located, SignalTraces, Traces
from imutool.diagnosis.wording.effect_sentences import signals
from imutool.units import AXES, COLUMNS, UNITS
from imutool.viewing.html.drawing import plain_tick_labels, svg
from imutool.viewing.html.page import AFTER, BEFORE, HELD, INK, MARK, TITLES
from imutool.viewing.model.decimation import DecimatedLine, Line, average_log_bins, decimate_extremes, true_intervals

BUCKETS = 600  # of a line; each draws its lowest and its highest sample
STRIP_BINS = 400
WELCH_S = 8.0  # longest window; shorter for short unseen stretches
MIN_SAMPLES = 32  # samples in a window, below which there is no spectrum
BINS = 16
MIN_BLOCKS = 3  # in a bin
BLOCK_S = 0.5  # one independent value each: the misfit of a motion lasts about this long
GAP_PERIODS = 1.5  # sample periods without a sample that end a stretch


def compared_signals(traces: Sequence[Traces]) -> Mapping[str, slice]:
    """Columns of the signals that were compared: of the gyro alone if no position is known."""
    positions = any(trace.truth is None or trace.truth.has_positions for trace in traces)
    return COLUMNS if positions else {"gyro": COLUMNS["gyro"]}


def misfit_strip(d: Diagnosis, trace: Traces) -> str:
    """Local misfit of each axis along one log, with located intervals and unseen time."""

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        names = [f"{signal} {axis}" for signal in compared_signals([trace]) for axis in AXES]
        lines, edges = len(names), np.linspace(trace.t_s[0], trace.t_s[-1], min(STRIP_BINS, len(trace.t_s)) + 1)
        heights = _local_rms(trace, edges)
        for row, name in enumerate(names):
            signal, axis = name.split()
            top = np.nanmax(heights[:, COLUMNS[signal]], initial=0.0)
            if top > 0.0:
                area = np.nan_to_num(heights[:, row]) / top * 0.9
                axes.fill_between(edges[:-1], -row, -row + area, step="post", color=INK, alpha=0.55, lw=0)
            for located in d.located:
                if axis in located.axes and signal in signals(located.signal):
                    for first, last in intervals_in_log(trace, located):
                        axes.fill_between([first, last], -row, -row + 0.94, color=MARK, alpha=0.3, lw=0)
        for first, last in true_intervals(trace.t_s, trace.held_out):
            axes.fill_between([first, last], -lines, 0.7 - lines, color=HELD, alpha=0.5, lw=0)
        axes.set_yticks([0.45 - row for row in range(lines + 1)], [*names, "unseen"])
        axes.set(xlim=(trace.t_s[0], trace.t_s[-1]), ylim=(-lines - 0.1, 1.0), xlabel="time (s)")
        axes.tick_params(axis="y", length=0)
        axes.grid(visible=False)

    return svg(draw, 2.6, "where")


def residual(trace: Traces, *, found: bool) -> str:
    """Residual of one log over time by axis, before and after; unseen time is shaded."""

    def draw(figure: Any) -> None:
        compared, both = compared_signals([trace]), [(trace.before, BEFORE), (trace.after, AFTER)][: 1 + found]
        panels = figure.subplots(3, len(compared), sharex=True, sharey="col", squeeze=False)
        sides = [(residual_in_band(trace, expected), color) for expected, color in both]
        for column, (signal, part) in enumerate(compared.items()):
            for row, axes in enumerate(panels[:, column]):
                for values, color in sides:
                    axes.plot(*decimate_extremes(trace.t_s, values[:, part][:, row], BUCKETS), color=color, lw=0.6)
                for first, last in true_intervals(trace.t_s, trace.held_out):
                    axes.axvspan(first, last, color=HELD, alpha=0.15, lw=0)
                axes.set_ylabel(f"{AXES[row]} ({UNITS[signal]})")
            panels[0, column].set_title(f"{TITLES[signal]}: real minus expected")
            panels[-1, column].set(xlabel="time (s)", xlim=(trace.t_s[0], trace.t_s[-1]))

    return svg(draw, 4.4, "residual")


def scalar_signal(traces: SignalTraces, *, found: bool) -> str:
    """Another signal over time: recorded, expected, and its residual before and after."""

    def draw(figure: Any) -> None:
        above, below = figure.subplots(2, 1, sharex=True)
        above.plot(*decimate_extremes(traces.t_s, traces.real, BUCKETS), color=INK, lw=0.9)
        for expected, color in [(traces.before, BEFORE), (traces.after, AFTER)][: 1 + found]:
            above.plot(*decimate_extremes(traces.t_s, expected, BUCKETS), color=color, lw=0.8)
            below.plot(*decimate_extremes(traces.t_s, traces.real - expected, BUCKETS), color=color, lw=0.6)
        for axes, title in ((above, "Recorded (ink) and expected"), (below, "Real minus expected")):
            for first, last in true_intervals(traces.t_s, traces.held_out):
                axes.axvspan(first, last, color=HELD, alpha=0.15, lw=0)
            axes.set_title(title)
            axes.set_ylabel(f"({traces.unit})" if traces.unit else "value")
        below.set(xlabel="time (s)", xlim=(traces.t_s[0], traces.t_s[-1]))

    return svg(draw, 3.6, "signal")


def spectrum(d: Diagnosis) -> str | None:
    """Amplitude density of the residual by Welch's method; None if too short."""
    compared = compared_signals(d.traces)
    density = {signal: [_density(d.traces, part, after) for after in (False, True)] for signal, part in compared.items()}
    if any(found is None for both in density.values() for found in both):
        return None

    def draw(figure: Any) -> None:
        for axes, (signal, both) in zip(figure.subplots(1, len(density), squeeze=False)[0], density.items(), strict=True):
            for found, color in list(zip(both, (BEFORE, AFTER), strict=True))[: 1 + bool(d.findings)]:
                assert found is not None, "checked above"
                axes.loglog(found[0], found[1], color=color, lw=1.1)
            if signal in d.unexplained:
                floor = d.unexplained[signal].noise_floor * np.sqrt(2.0 / rate_hz(d.traces[0]))
                axes.axhline(floor, color=INK, lw=1.0, ls=(0, (4, 3)))
            plain_tick_labels(axes.xaxis, axes.yaxis)
            low, high = axes.get_ylim()
            axes.set_ylim(10.0 ** np.floor(np.log10(low)), 10.0 ** np.ceil(np.log10(high)))  # whole decades have labels
            axes.set(xlabel="frequency (Hz)", ylabel=f"density ({UNITS[signal]}/√Hz)", title=TITLES[signal])

    return svg(draw, 2.9, "spectrum")


def residual_against_rate(d: Diagnosis) -> str | None:
    """Mean residual in bins of turning rate: gyro about its own axis, accel by the total rate."""

    def variable(trace: Traces, signal: str, axis: int) -> Line:
        rate: Line = trace.before[:, axis] if signal == "gyro" else np.linalg.norm(trace.before[:, :3], axis=1)
        return rate

    return _binned(d, variable, {"gyro": "rate about {} (rad/s)", "accel": "turning rate (rad/s)"}, "rate")


def residual_against_attitude(d: Diagnosis) -> str | None:
    """Mean residual in bins of an axis's elevation above the horizon; None without attitude."""

    def variable(trace: Traces, signal: str, axis: int) -> Line:
        assert trace.truth is not None, "checked by the caller"
        up_b = Rotation.from_quat(trace.truth.q_wb_wxyz, scalar_first=True).apply([0.0, 0.0, 1.0], inverse=True)
        rise: Line = np.degrees(np.arcsin(np.clip(up_b[:, axis], -1.0, 1.0)))
        return rise

    if any(trace.truth is None for trace in d.traces):
        return None
    return _binned(d, variable, dict.fromkeys(COLUMNS, "{} above the horizon (°)"), "attitude")


def curve(smooth: Curve, signal: str) -> str:
    """Curve of a finding without a name over its variable, one panel per axis, with its band."""
    all_y, all_bands = np.array(smooth.y), np.array(smooth.band)

    def draw(figure: Any) -> None:
        count = all_y.shape[1]
        drawn = [k for k in range(count) if all_y[:, k].any() or all_bands[:, k].any()]
        panels = figure.subplots(1, max(len(drawn), 1), squeeze=False, sharey=True)[0]
        for k, axes in zip(drawn, panels, strict=False):
            y, band = all_y[:, k], all_bands[:, k]
            axes.fill_between(smooth.x, y - band, y + band, color=AFTER, alpha=0.3, lw=0)
            axes.plot(smooth.x, y, color=AFTER, lw=1.4)
            axes.axhline(0.0, color=INK, lw=0.6)
            axes.set_title(f"{signal} {AXES[k]}" if count == 3 else signal)
            axes.set_xlabel(f"{smooth.variable} ({smooth.unit})")
            axes.locator_params(axis="x", nbins=6)
        panels[0].set_ylabel(f"misfit ({UNITS[signal]})" if signal in UNITS else "misfit")

    return svg(draw, 2.6, "curve")


def intervals_in_log(trace: Traces, located: Located) -> Iterator[tuple[float, float]]:
    """Intervals of a located misfit within a log; without a log's name they hold for all logs."""
    if located.log not in ("", trace.path):
        return
    for first, last in located.intervals_s:
        low, high = max(first, float(trace.t_s[0])), min(last, float(trace.t_s[-1]))
        if low < high:
            yield low, high


def residual_in_band(trace: Traces, expected: Float64[np.ndarray, "n 6"]) -> Float64[np.ndarray, "n 6"]:
    """Residual below the frequency up to which the expected signal is known."""
    residual: Float64[np.ndarray, "n 6"] = trace.real - expected
    if trace.band_hz is None:
        return np.asarray(residual)
    taps = Band.below(trace.band_hz, rate_hz(trace)).taps
    return np.asarray(fftconvolve(residual, taps[:, None], mode="same", axes=0))


def held_out_mask(trace: Traces) -> Bool[np.ndarray, " n"]:
    """Mask of the samples that no fit has seen; all samples where none was held out."""
    return trace.held_out if trace.held_out.any() else np.ones_like(trace.held_out)


def rate_hz(trace: Traces) -> float:
    """Sample rate by the median step."""
    return 1.0 / float(np.median(np.diff(trace.t_s)))


def _local_rms(trace: Traces, edges: Line) -> Float64[np.ndarray, "bins 6"]:
    """Root mean square of the misfit before between edges; NaN without samples."""
    squares = residual_in_band(trace, trace.before) ** 2
    finite = np.isfinite(squares)
    bins = np.clip(np.searchsorted(edges, trace.t_s, side="right") - 1, 0, len(edges) - 2)
    sums, counts = np.zeros((2, len(edges) - 1, 6))
    np.add.at(sums, bins, np.where(finite, squares, 0.0))
    np.add.at(counts, bins, finite)
    out: Float64[np.ndarray, "bins 6"] = np.sqrt(np.where(counts > 0, sums, np.nan) / np.maximum(counts, 1))
    return out


def _density(traces: Sequence[Traces], part: slice, after: bool) -> tuple[Line, Line] | None:
    """Amplitude density and frequencies over unseen stretches of all logs, weighted by length."""
    pieces = [(rate_hz(trace), piece) for trace in traces for piece in _stretches(trace, part, after)]
    longest_s = max((len(piece) / rate for rate, piece in pieces), default=0.0)
    window_s = min(WELCH_S, 2.0 ** np.floor(np.log2(max(longest_s, 1e-9))))
    pieces = [(rate, piece) for rate, piece in pieces if len(piece) >= max(round(window_s * rate), MIN_SAMPLES)]
    if not pieces:
        return None
    highest = min(rate for rate, _ in pieces) / 2.0
    frequency = np.arange(1, int(highest * window_s) + 1) / window_s
    total, weight = np.zeros(len(frequency)), 0.0
    for rate, piece in pieces:
        at, power = welch(piece, fs=rate, nperseg=round(window_s * rate), axis=0)
        total += len(piece) * np.interp(frequency, at, power.mean(axis=1))
        weight += len(piece)
    at, density = average_log_bins(frequency, total / weight, 1.0 / window_s)
    return at, np.sqrt(density)


def _stretches(trace: Traces, part: slice, after: bool) -> Iterator[Float64[np.ndarray, "m 3"]]:
    """Residual over unseen time, split where samples are missing."""
    residual = (trace.real - (trace.after if after else trace.before))[:, part]
    rows = np.flatnonzero(held_out_mask(trace) & np.isfinite(residual).all(axis=1))
    for piece in np.split(rows, np.flatnonzero(np.diff(trace.t_s[rows]) > GAP_PERIODS / rate_hz(trace)) + 1):
        if len(piece) >= MIN_SAMPLES:
            yield residual[piece]


def _binned(d: Diagnosis, variable: Callable[[Traces, str, int], Line], names: dict[str, str], name: str) -> str | None:
    """Binned means over all logs, before and after, one panel per signal and axis."""
    if not d.traces:
        return None

    compared = compared_signals(d.traces)

    def draw(figure: Any) -> None:
        panels = figure.subplots(len(compared), 3, sharey="row", squeeze=False)
        kinds = ((False, BEFORE), (True, AFTER))[: 1 + bool(d.findings)]
        sides = [([residual_in_band(t, t.after if found else t.before) for t in d.traces], color) for found, color in kinds]
        for row, (signal, part) in enumerate(compared.items()):
            for axis, axes in enumerate(panels[row]):
                x = np.concatenate([variable(trace, signal, axis)[held_out_mask(trace)] for trace in d.traces])
                since_s = [(trace.t_s - trace.t_s[0])[held_out_mask(trace)] for trace in d.traces]
                blocks = np.concatenate([np.floor(t_s / BLOCK_S) + 1e6 * k for k, t_s in enumerate(since_s)])
                for values, color in sides:
                    y = np.concatenate(
                        [residual[held_out_mask(t), part][:, axis] for residual, t in zip(values, d.traces, strict=True)]
                    )
                    centre, mean, band = means(x, y, blocks)
                    axes.fill_between(centre, mean - band, mean + band, color=color, alpha=0.25, lw=0)
                    axes.plot(centre, mean, color=color, lw=1.2, marker="o", ms=2.5)
                axes.axhline(0.0, color=INK, lw=0.6)
                axes.set_xlabel(names[signal].format(AXES[axis]))
                axes.set_title(f"{TITLES[signal]} {AXES[axis]}")
                axes.locator_params(axis="x", nbins=6)
            panels[row, 0].set_ylabel(f"mean misfit ({UNITS[signal]})")

    return svg(draw, 2.1 * len(compared), name)


def means(x: Line, y: Line, blocks: Float64[np.ndarray, " n"]) -> tuple[DecimatedLine, DecimatedLine, DecimatedLine]:
    """Bin centres, means and two standard errors, with one independent value per block of time."""
    good = np.isfinite(x) & np.isfinite(y)
    x, y, blocks = x[good], y[good], blocks[good]
    if not len(x):
        return x, y, y
    low, high = np.percentile(x, [0.5, 99.5])
    edges = np.linspace(low, high if high > low else low + 1e-9, BINS + 1)
    bins = np.searchsorted(edges, x, side="right") - 1
    rows = []
    for k in range(BINS):
        in_bin = bins == k
        owner = np.unique(blocks[in_bin], return_inverse=True)[1]
        if in_bin.any() and owner.max() + 1 >= MIN_BLOCKS:
            sums = np.bincount(owner, y[in_bin] - y[in_bin].mean())  # summed in a block, errors that go together count together
            rows.append((edges[k : k + 2].mean(), y[in_bin].mean(), 2.0 * np.linalg.norm(sums) / len(owner)))
    centre, mean, band = np.array(rows).reshape(-1, 3).T
    return centre, mean, band
