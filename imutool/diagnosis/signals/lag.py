"""Lag of a recording behind its simulation at first sight; copies of one log in the other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline, make_interp_spline
from scipy.signal import correlate, correlation_lags

from imutool.array_types import Float64
from imutool.diagnosis.estimation.aligned_log import ClockDifference
from imutool.diagnosis.settings import DiagnoseSettings
from imutool.diagnosis.signals.ideal_signal import SignalPair
from imutool.errors import DataError
from imutool.inertial.correlation import dependent_samples
from imutool.recording import nanoseconds, seconds

Column = Float64[np.ndarray, "_"]
Columns = Float64[np.ndarray, "_ k"]
MIN_COPIED = 0.9  # of the longer log's time, that two copies share
SAME, DIGITS = 1e-6, 1e-7  # of a column's deviation, and of its largest value, as float32 has it
INTERPOLATED, MAX_INTERPOLATED = 0.1, 1e-4  # of the error over twice the step; of a column's deviation
UNLIKE_SIZE = 0.2  # of the logarithm: copies that share most of their time are no farther apart
MIN_INTERPOLATED = 8  # samples
MIN_SIZE = 1e-100  # of a constant
SHIFTS = 4  # Newton steps from a lag at first sight


def lag_at_first_sight(pair: SignalPair, settings: DiagnoseSettings) -> tuple[float, float | None]:
    """Lag (s) of the recording at first sight, and the clock shift (s) if no epoch is shared.

    Raises:
        DataError: nowhere are the two alike.
    """
    own, ((t_real, real), (t_sim, sim)) = settings.signal, _sides(pair)
    a, b = (
        np.stack([_smooth(t_s, column, own.align_hz) for column in values.T]) for t_s, values in ((t_real, real), (t_sim, sim))
    )
    if len(pair.names) > 1:  # columns of one size each, so that none decides for all
        size = np.maximum(b.std(axis=1, keepdims=True), 1e-300)
        a, b = a / size, b / size
    total = np.sum([correlate(x, y, mode="full") for x, y in zip(a, b, strict=True)], axis=0)
    correlation = total / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-300)
    lags = correlation_lags(a.shape[1], b.shape[1]) / own.align_hz + float(t_real[0] - t_sim[0])
    shared = min(t_real[-1], t_sim[-1]) - max(t_real[0], t_sim[0])
    length = min(t_real[-1] - t_real[0], t_sim[-1] - t_sim[0])
    near, chance = np.abs(lags) <= settings.alignment.farthest_s, _chance(a, b)
    minimum = [float(np.clip(np.tanh(z * chance), own.min_correlation, own.max_demanded)) for z in own.alike_sigma]
    if shared > max(own.min_s, 0.5 * length) and near.any() and np.abs(correlation[near]).max() > minimum[0]:
        return float(lags[near][np.argmax(np.abs(correlation[near]))]), None
    best = int(np.argmax(correlation))
    if correlation[best] < minimum[1]:
        raise DataError(
            f"recording and simulation of {pair.names[0]} are not alike (correlation {correlation[best]:.2f} at best;"
            f" two unrelated motions reach {minimum[1]:.2f})",
            where=pair.names[0],
            expected="one motion",
            fix="Simulate what was recorded, or choose another field",
        )
    return 0.0, -float(lags[best])


def on_recorded_clock(pair: SignalPair, clock: ClockDifference | None) -> SignalPair:
    """Pair with both logs on one clock, where the difference is known."""
    if clock is None:
        return pair
    ahead_ns = nanoseconds(clock.ahead_s)
    state = {name: replace(values, t_ns=values.t_ns - ahead_ns) for name, values in pair.sim_state.items()}
    return replace(pair, sim_ns=pair.sim_ns - ahead_ns, sim_state=state, clock_std_s=clock.std_s)


def _chance(a: Float64[np.ndarray, "k n"], b: Float64[np.ndarray, "k m"]) -> float:
    """Deviation of the correlation of two independent signals with these spectra."""
    n = min(a.shape[1], b.shape[1])
    variances = [dependent_samples(x, y) / n for x, y in zip(a, b, strict=True)]
    return float(np.sqrt(np.mean(variances) / len(variances)))


def _smooth(t_s: Column, values: Column, rate_hz: float) -> Float64[np.ndarray, " _"]:
    """On an even clock, without its mean."""
    at = np.arange(t_s[0], t_s[-1], 1.0 / rate_hz)
    even = np.interp(at, t_s, values)
    return np.asarray(even - even.mean())


def _sides(pair: SignalPair) -> list[tuple[Column, Columns]]:
    """Stamps (s from the recording's first) and values of the recording, and of the simulation."""
    start_ns = int(pair.real_ns[0])
    return [(seconds(pair.real_ns, start_ns), pair.real), (seconds(pair.sim_ns, start_ns), pair.sim)]


# ── copies ──


def is_copy(pair: SignalPair, settings: DiagnoseSettings) -> bool:
    """Whether one log copies the other, but for epoch, digits and interpolation.

    No sensor reads what a simulation computes to a millionth of its motion.
    """
    sides = _sides(pair)
    if any(len(t) < MIN_INTERPOLATED or (np.diff(t) <= 0.0).any() for t, _ in sides):
        return False
    sizes = [np.maximum(values.std(axis=0), MIN_SIZE) for _, values in sides]
    if (np.abs(np.log(sizes[0] / sizes[1])) > UNLIKE_SIZE).any():  # saves the correlation
        return False
    try:
        shift_s = lag_at_first_sight(pair, settings)[1]
    except DataError:  # too short or too unlike for a lag: copies have none on one clock
        shift_s = None
    if shift_s is not None:
        sides = _sides(on_recorded_clock(pair, ClockDifference(shift_s, 0.0)))
    shifts = 1 if shift_s is None and not pair.clock_std_s else SHIFTS
    coarse, dense = sorted(sides, key=lambda side: -float(np.median(np.diff(side[0]))))
    return any(_is_within(*first, *other, shifts) for first, other in ((coarse, dense), (dense, coarse)))


def _is_within(
    t_s: Column, values: Float64[np.ndarray, "_ k"], t_other: Column, others: Float64[np.ndarray, "_ k"], shifts: int
) -> bool:
    """Whether values are interpolated from others, along a spline or straight lines, at some shift near zero."""
    size, missed = np.maximum(values.std(axis=0), MIN_SIZE), _interpolation_error(t_other, others)
    allowed = np.maximum(SAME * size, np.minimum(missed, MAX_INTERPOLATED * size)) + DIGITS * np.abs(values).max(axis=0)
    spline, lines, moved = CubicSpline(t_other, others), make_interp_spline(t_other, others, k=1), 0.0
    for _ in range(shifts):
        at = t_s + moved
        inside = (at >= t_other[0]) & (at <= t_other[-1])
        if inside.sum() * np.ptp(t_s) / len(t_s) < MIN_COPIED * max(np.ptp(t_s), np.ptp(t_other)):
            return False
        each = [values[inside] - curve(at[inside]) for curve in (spline, lines)]
        if any((np.sqrt((residual**2).mean(axis=0)) <= allowed).all() for residual in each):
            return True
        slope = spline(at[inside], 1) / size
        moved += float((each[0] / size * slope).sum() / max(float((slope**2).sum()), 1e-300))
    return False


def _interpolation_error(t_s: Column, values: Float64[np.ndarray, "_ k"]) -> Float64[np.ndarray, " k"]:
    """Error of a cubic spline between samples: a 16th of that between every second one."""
    error = CubicSpline(t_s[::2], values[::2])(t_s[1:-1:2]) - values[1:-1:2]
    return np.asarray(INTERPOLATED * np.sqrt((error**2).mean(axis=0)))
