"""IMU from two sensors, on the gyro's stamps; their delay, and the gyro's unit.

While the specific force is mostly gravity, a vector that is fixed in the world, da/dt = -omega x a. The delay is the lag at
which both sides correlate best.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.errors import DataError
from imutool.geometry import quaternion
from imutool.recording import Imu, interpolate
from imutool.recording.columns import longest_run
from imutool.recording.sample_order import Cleaned, in_order

STEP_S = 0.005
SMOOTHED = 11  # steps; the same of both sensors, so that it adds no delay
LONGEST_S = 0.15
MAX_S = 300.0  # of a longer log, the stretch that turns most
PARTS = 8  # stretches whose own lags show how sure the delay is
MIN_CORRELATION, MIN_PARTS = 0.6, 4
WINDOW_S, TURN_S = 2.0, 0.02  # over which the specific force is mostly gravity, and the steps of its turns
MIN_T = 3.0  # from which on a unit is certain


class SensorDelay(NamedTuple):
    """Lateness of the accelerometer's stamps against the gyroscope's, with its deviation."""

    seconds: float
    std_s: float


def sensor_delay(
    gyro_ns: Int64[np.ndarray, " n"],
    gyro: Float64[np.ndarray, "n 3"],
    accel_ns: Int64[np.ndarray, " m"],
    accel: Float64[np.ndarray, "m 3"],
) -> SensorDelay | None:
    """Delay of the accelerometer; None where the motion does not show it."""
    both = _together(gyro_ns, gyro, accel_ns, accel)
    if both is None:
        return None
    maximum = round(LONGEST_S / STEP_S)
    lags = np.arange(-maximum, maximum + 1)
    products = np.stack([_products(*both, int(lag), maximum) for lag in lags])
    whole = _peak(products.sum(axis=1), lags)
    if whole is None:
        return None
    parts = [peak for part in range(PARTS) if (peak := _peak(products[:, part], lags)) is not None]
    if len(parts) < MIN_PARTS:
        return None
    spread_s = float(np.std(parts, ddof=1)) * STEP_S / len(parts) ** 0.5
    return SensorDelay(whole * STEP_S, max(spread_s, _min_std(both, products.sum(axis=1))))


def _min_std(
    both: tuple[Float64[np.ndarray, "c 3"], Float64[np.ndarray, "c 3"]], products: Float64[np.ndarray, "k 3"]
) -> float:
    """Least standard deviation (s) of the lag of two signals, by what they do not have in common.

    It is that of Cramer and Rao for a delay, tan(acos r) / (w sqrt(n)): r is the correlation, w the rms frequency (rad/s), and
    n = 3 T w / pi the independent samples of three axes. A motion that repeats has the same error in each stretch.
    """
    together, measured, predicted = products.T
    r = float(np.clip((together / np.sqrt(np.maximum(measured * predicted, 1e-300))).max(), MIN_CORRELATION, 1.0))
    turn = -np.cross(*both)
    w = float(np.sqrt((np.gradient(turn, STEP_S, axis=0) ** 2).sum() / max(float((turn**2).sum()), 1e-300)))
    samples = 3.0 * STEP_S * len(turn) * w / np.pi
    return float(np.sqrt(1.0 - r**2) / r / (w * np.sqrt(samples))) if w > 0.0 else float("inf")


def unit_by_gravity(
    t_ns: Int64[np.ndarray, " n"],
    gyro: Float64[np.ndarray, "n 3"],
    accel: Float64[np.ndarray, "n 3"],
    units: Mapping[str, float],
) -> tuple[str, float] | None:
    """Unit of the gyro that keeps gravity still, and its t value against others; else None.

    `units` are in rad/s. In each window the specific force is turned back by the gyro: with the right unit its mean is longest.
    Half and twice each unit compete, so that a scale which is none of them finds none.
    """
    both = _together(t_ns, gyro, t_ns, accel)
    if both is None:
        return None
    rate, force = (_in_windows(values) for values in both)
    sizes = [(name, unit * factor) for name, unit in units.items() for factor in (1.0, 0.5, 2.0)]
    lengths = np.stack([_turned_back(rate * size, force) for _, size in sizes])
    best = int(np.argmax(lengths.sum(axis=1)))
    gains = lengths[best] - np.delete(lengths, best, axis=0)
    t = float((gains.mean(axis=1) * gains.shape[1] ** 0.5 / np.maximum(gains.std(axis=1, ddof=1), 1e-300)).min())
    name, size = sizes[best]
    return (name, t) if size == units[name] and t > MIN_T else None


def steady_force(
    t_ns: Int64[np.ndarray, " n"], gyro: Float64[np.ndarray, "n 3"], accel: Float64[np.ndarray, "n 3"]
) -> float | None:
    """Median size (m/s²) of the mean specific force over 2 s, turned back by the gyro.

    It is about gravity, unless gravity was taken out. None of a log too short for it.
    """
    both = _together(t_ns, gyro, t_ns, accel)
    if both is None:
        return None
    rate, force = (_in_windows(values) for values in both)
    return float(np.median(_turned_back(rate, force)))


def _in_windows(values: Float64[np.ndarray, "c 3"]) -> Float64[np.ndarray, "w k 3"]:
    """Means over TURN_S, in windows of WINDOW_S."""
    inside, length = round(TURN_S / STEP_S), round(WINDOW_S / TURN_S)
    whole = len(values) // (inside * length)
    windows: Float64[np.ndarray, "w k 3"] = values[: whole * inside * length].reshape(whole, length, inside, 3).mean(axis=2)
    return windows


def _turned_back(rate: Float64[np.ndarray, "w k 3"], force: Float64[np.ndarray, "w k 3"]) -> Float64[np.ndarray, " w"]:
    """Length of the mean specific force of each window in the frame of its first sample."""
    q_wxyz = np.tile([1.0, 0.0, 0.0, 0.0], (len(rate), 1))
    total = np.zeros((len(rate), 3))
    for k in range(rate.shape[1]):
        total += quaternion.rotate(q_wxyz, force[:, k])
        q_wxyz = quaternion.multiply(q_wxyz, quaternion.exp(rate[:, k] * TURN_S))
    return np.asarray(quaternion.length(total) / rate.shape[1])


def _together(
    gyro_ns: Int64[np.ndarray, " n"],
    gyro: Float64[np.ndarray, "n 3"],
    accel_ns: Int64[np.ndarray, " m"],
    accel: Float64[np.ndarray, "m 3"],
) -> tuple[Float64[np.ndarray, "c 3"], Float64[np.ndarray, "c 3"]] | None:
    """Rates and specific forces on one grid, of a long log the stretch that turns most; None of too short a log."""
    on_one_clock = gyro_ns[longest_run(gyro_ns)]
    start = max(int(on_one_clock[0]), int(accel_ns[0]))
    count = int((min(int(on_one_clock[-1]), int(accel_ns[-1])) - start) * 1e-9 / STEP_S)
    if count < PARTS * 10 * round(LONGEST_S / STEP_S):
        return None
    first, last = 0, count
    rate = _resampled(gyro_ns, gyro, start, first, last)
    if count * STEP_S > MAX_S:
        window = round(MAX_S / STEP_S)
        turned = np.concatenate([[0.0], np.cumsum(rate[:, 0] ** 2 + rate[:, 1] ** 2 + rate[:, 2] ** 2)])
        first = int(np.argmax(turned[window:] - turned[:-window]))
        last = first + window
        rate = rate[first:last].copy()
    before, behind = min(first, SMOOTHED), min(count - last, SMOOTHED)  # steps that the smoothing takes in
    force = _resampled(accel_ns, accel, start, first - before, last + behind)
    return rate, force[before : len(force) - behind]


def _resampled(
    t_ns: Int64[np.ndarray, " n"], values: Float64[np.ndarray, "n 3"], start: int, first: int, last: int
) -> Float64[np.ndarray, "c 3"]:
    """Smoothed values at the equal steps `first` to `last`, which count from the time `start`."""
    t, grid, mean = (t_ns - start) * 1e-9, STEP_S * np.arange(first, last), np.full(SMOOTHED, 1.0 / SMOOTHED)
    smoothed = np.empty((last - first, 3))
    for column, out in zip(values.T, smoothed.T, strict=True):
        out[:] = np.convolve(np.interp(grid, t, column), mean, "same")
    return smoothed


def _products(
    rate: Float64[np.ndarray, "c 3"], force: Float64[np.ndarray, "c 3"], lag: int, maximum: int
) -> Float64[np.ndarray, "8 3"]:
    """Sums of products of measured and predicted change, and of their squares, by part."""
    inner = slice(maximum, len(rate) - maximum)
    moved = np.roll(force, -lag, axis=0)
    measured = np.gradient(moved, STEP_S, axis=0)[inner]
    predicted = -np.cross(rate, moved)[inner]
    sums = [(measured * predicted).sum(axis=1), (measured**2).sum(axis=1), (predicted**2).sum(axis=1)]
    return np.array([[part.sum() for part in np.array_split(column, PARTS)] for column in sums]).T


def _peak(products: Float64[np.ndarray, "k 3"], lags: Int64[np.ndarray, " k"]) -> float | None:
    """Lag of the best correlation between steps; None of a weak one, or at the end of the lags."""
    together, measured, predicted = products.T
    correlation = together / np.sqrt(np.maximum(measured * predicted, 1e-300))
    best = int(np.argmax(correlation))
    if correlation[best] < MIN_CORRELATION or best in (0, len(lags) - 1):
        return None
    before, at, after = correlation[best - 1 : best + 2]
    return float(lags[best] + 0.5 * (before - after) / (before - 2.0 * at + after))


SHOWN_STDS = 3.0  # standard deviations from which on a delay is told from none
MIN_COMMON = 0.9  # share of the stamps that sensors on one clock have in common
LONGEST_ALONE_S = 1.0  # of the accelerometer before and after the gyro, as sensors that start one by one have
MAX_GAP_PERIODS = 4.0  # of the accelerometer, across which nothing is interpolated


class JoinedSamples(NamedTuple):
    """IMU on the gyro's stamps, the places of its samples among the gyro's, and notes."""

    imu: Imu
    rows: Int64[np.ndarray, " n"]
    notes: list[str]


def joined(
    gyro_ns: Int64[np.ndarray, " n"],
    gyro: Float64[np.ndarray, "n 3"],
    accel_ns: Int64[np.ndarray, " m"],
    accel: Float64[np.ndarray, "m 3"],
    name: str,
    *,
    spread: bool = True,
) -> JoinedSamples:
    """IMU on the gyro's stamps, with notes on what was interpolated, spread and left out.

    Raises:
        DataError: the two sensors share no time, or no sample of one is finite.
    """
    if np.array_equal(gyro_ns, accel_ns) and (whole := _in_rows(gyro_ns, gyro, accel, name, spread=spread)) is not None:
        return whole
    rates = in_order(gyro_ns, gyro, f"{name} gyro", spread=spread)
    forces = in_order(accel_ns, accel, f"{name} accel", spread=spread)
    notes = rates.notes + forces.notes
    t_ns, first, second = np.intersect1d(rates.t_ns, forces.t_ns, assume_unique=True, return_indices=True)
    if len(t_ns) > MIN_COMMON * max(len(rates.t_ns), len(forces.t_ns)):  # one clock: a sample that one of them lacks is none
        alone = len(rates.t_ns) + len(forces.t_ns) - 2 * len(t_ns)
        notes += [f"{name}: {alone} samples that gyro or accel alone has are left out"] if alone else []
        return JoinedSamples(Imu(t_ns, rates.values[first], forces.values[second]), rates.rows[first], notes)
    for sensor, given, kept in (("gyro", gyro_ns, rates), ("accelerometer", accel_ns, forces)):
        if len(given) and not len(kept.t_ns):
            raise DataError(f"none of the {len(given)} samples of the {sensor} is finite", where=name, expected="numbers")
    if len(rates.t_ns) < 2 or len(forces.t_ns) < 2 or rates.t_ns[0] >= forces.t_ns[-1] or rates.t_ns[-1] <= forces.t_ns[0]:
        raise DataError("gyro and accelerometer share no time", where=name, expected="two sensors that run together")
    after = np.clip(np.searchsorted(forces.t_ns, rates.t_ns), 1, len(forces.t_ns) - 1)
    periods = np.diff(forces.t_ns)
    limit = MAX_GAP_PERIODS * float(np.median(periods))
    inside = (rates.t_ns >= forces.t_ns[0]) & (rates.t_ns <= forces.t_ns[-1]) & (periods[after - 1] <= limit)
    start = forces.t_ns[0]
    accel_there = interpolate((rates.t_ns[inside] - start).astype(float), (forces.t_ns - start).astype(float), forces.values)
    rate_hz = [1e9 / float(np.median(np.diff(c.t_ns))) for c in (rates, forces)]
    notes.append(
        f"{name}: gyro at {rate_hz[0]:.1f} Hz and accelerometer at {rate_hz[1]:.1f} Hz became one IMU on the gyro's stamps, "
        f"the accelerometer interpolated; {_delay_sentence(rates, forces)}"
    )
    if not inside.all():
        notes.append(f"{name}: gyro samples without an accelerometer sample near them: {int((~inside).sum())}")
    alone = (forces.t_ns < rates.t_ns[0]) | (forces.t_ns > rates.t_ns[-1])
    if (alone_s := alone.sum() / rate_hz[1]) > LONGEST_ALONE_S:
        note = f"{int(alone.sum())} accelerometer samples ({alone_s:.1f} s) before or after all of the gyro's are left out"
        notes.append(f"{name}: {note}: are both of one recording?")
    return JoinedSamples(Imu(rates.t_ns[inside], rates.values[inside], accel_there), rates.rows[inside], notes)


def _in_rows(
    t_ns: Int64[np.ndarray, " n"],
    gyro: Float64[np.ndarray, "n 3"],
    accel: Float64[np.ndarray, "n 3"],
    name: str,
    *,
    spread: bool,
) -> JoinedSamples | None:
    """IMU of rows with both sensors; None where many rows have one of them alone."""
    has_gyro, has_accel = (np.isfinite(values).all(axis=1) for values in (gyro, accel))
    both = np.flatnonzero(has_gyro & has_accel)
    if len(both) <= MIN_COMMON * max(has_gyro.sum(), has_accel.sum()):
        return None
    if len(both) == len(t_ns) and (np.diff(t_ns) > 0).all():  # as nearly all tables are: nothing is copied
        return JoinedSamples(Imu(t_ns, gyro, accel), both, [])
    parts = (("gyro", has_gyro), ("accel", has_accel))
    notes = [f"{name} {s}: {(~has).sum()} samples that are not finite are left out" for s, has in parts if not has.all()]
    if alone := int((has_gyro != has_accel).sum()):
        notes.append(f"{name}: {alone} samples that gyro or accel alone has are left out")
    kept = in_order(t_ns[both], np.concatenate([gyro[both], accel[both]], axis=1), name, spread=spread)
    return JoinedSamples(Imu(kept.t_ns, kept.values[:, :3], kept.values[:, 3:]), both[kept.rows], notes + kept.notes)


def _delay_sentence(rates: Cleaned, forces: Cleaned) -> str:
    """Delay between the sensors, as the motion shows it."""
    delay = sensor_delay(rates.t_ns, rates.values, forces.t_ns, forces.values)
    if delay is None:
        return "the motion does not show the delay between them"
    if abs(delay.seconds) < SHOWN_STDS * delay.std_s:
        return f"the motion shows no delay between them ({1e3 * delay.seconds:+.1f} ± {1e3 * delay.std_s:.1f} ms)"
    side = "later" if delay.seconds > 0 else "earlier"
    size = f"{abs(delay.seconds) * 1e3:.1f} ms {side} than the gyro's (standard deviation {delay.std_s * 1e3:.1f} ms)"
    return f"by the motion the accelerometer's stamps are {size}, which is not corrected"
