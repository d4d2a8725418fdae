"""Delay between a gyroscope and an accelerometer, and the gyro's unit, from how gravity turns in the body.

While the specific force is mostly gravity, a vector that is fixed in the world, da/dt = -omega x a. The delay is the lag at
which both sides correlate best.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

STEP_S = 0.005
SMOOTHED = 11  # steps; the same of both sensors, so that it adds no delay
LONGEST_S = 0.15
MOST_S = 300.0  # of a longer log, the stretch that turns most
PARTS = 8  # stretches whose own lags show how sure the delay is
LEAST_CORRELATION, LEAST_PARTS = 0.6, 4


MOST_OFF = 1.3  # ratio of the part's scale to that of a unit


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
    most = round(LONGEST_S / STEP_S)
    lags = np.arange(-most, most + 1)
    products = np.stack([_products(*both, int(lag), most) for lag in lags])
    whole = _peak(products.sum(axis=1), lags)
    if whole is None:
        return None
    parts = [peak for part in range(PARTS) if (peak := _peak(products[:, part], lags)) is not None]
    if len(parts) < LEAST_PARTS:
        return None
    return SensorDelay(whole * STEP_S, float(np.std(parts, ddof=1)) * STEP_S / len(parts) ** 0.5)


def unit_by_gravity(
    t_ns: Int64[np.ndarray, " n"],
    gyro: Float64[np.ndarray, "n 3"],
    accel: Float64[np.ndarray, "n 3"],
    units: Mapping[str, float],
) -> tuple[str, float] | None:
    """Unit of the gyro under which it carries gravity along, and the correlation; None where the motion shows none.

    `units` are in rad/s. The scale of the least squares of da/dt = -scale omega x a decides, in the whole and in most parts.
    """
    both = _together(t_ns, gyro, t_ns, accel)
    if both is None:
        return None
    parts = _products(*both, 0, round(LONGEST_S / STEP_S))
    together, measured, predicted = np.concatenate([parts.sum(axis=0)[None], parts]).T
    correlation = together / np.sqrt(np.maximum(measured * predicted, 1e-300))
    scale = np.where(correlation >= LEAST_CORRELATION, together, 0.0) / np.maximum(predicted, 1e-300)
    for unit, size in units.items():
        close = (scale / size < MOST_OFF) & (scale / size > 1.0 / MOST_OFF)
        if close[0] and close[1:].sum() >= LEAST_PARTS:
            return unit, float(correlation[0])
    return None


def _together(
    gyro_ns: Int64[np.ndarray, " n"],
    gyro: Float64[np.ndarray, "n 3"],
    accel_ns: Int64[np.ndarray, " m"],
    accel: Float64[np.ndarray, "m 3"],
) -> tuple[Float64[np.ndarray, "c 3"], Float64[np.ndarray, "c 3"]] | None:
    """Rates and specific forces on one grid, of a long log the stretch that turns most; None of too short a log."""
    start = max(int(gyro_ns[0]), int(accel_ns[0]))
    count = int((min(int(gyro_ns[-1]), int(accel_ns[-1])) - start) * 1e-9 / STEP_S)
    if count < PARTS * 10 * round(LONGEST_S / STEP_S):
        return None
    rate = _resampled(gyro_ns, gyro, start, count)
    force = _resampled(accel_ns, accel, start, count)
    if count * STEP_S > MOST_S:
        window = round(MOST_S / STEP_S)
        turned = np.concatenate([[0.0], np.cumsum((rate**2).sum(axis=1))])
        first = int(np.argmax(turned[window:] - turned[:-window]))
        rate, force = rate[first : first + window], force[first : first + window]
    return rate, force


def _resampled(
    t_ns: Int64[np.ndarray, " n"], values: Float64[np.ndarray, "n 3"], start: int, count: int
) -> Float64[np.ndarray, "c 3"]:
    """Values at equal steps, smoothed."""
    t, grid = (t_ns - start) * 1e-9, STEP_S * np.arange(count)
    mean = np.full(SMOOTHED, 1.0 / SMOOTHED)
    return np.stack([np.convolve(np.interp(grid, t, column), mean, "same") for column in values.T], axis=1)


def _products(
    rate: Float64[np.ndarray, "c 3"], force: Float64[np.ndarray, "c 3"], lag: int, most: int
) -> Float64[np.ndarray, "8 3"]:
    """Sums of products of measured and predicted change, and of their squares, by part."""
    inner = slice(most, len(rate) - most)
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
    if correlation[best] < LEAST_CORRELATION or best in (0, len(lags) - 1):
        return None
    before, at, after = correlation[best - 1 : best + 2]
    return float(lags[best] + 0.5 * (before - after) / (before - 2.0 * at + after))
