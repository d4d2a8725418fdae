"""Held-out residuals: root mean squares, gain of the findings, whiteness."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from scipy.stats import f as fisher
from scipy.stats import ttest_1samp

from imutool.diagnosis.estimation.aligned_log import Pair
from imutool.diagnosis.estimation.alignment import LEAST_NOISE
from imutool.diagnosis.estimation.jacobians import Chosen, expected
from imutool.diagnosis.estimation.noise_estimate import noise_std
from imutool.diagnosis.estimation.whitening import WhitenedImu
from imutool.diagnosis.result import Closer, HeldOut, Unexplained
from imutool.diagnosis.settings import HeldOutSettings
from imutool.units import ASCII_UNITS, SENSORS


def with_effects(pair: Pair, chosen: Chosen) -> Float64[np.ndarray, "n 6"]:
    """Expected samples with some effects and the best constant."""
    return with_constant(pair, expected(pair, chosen))


def with_constant(pair: Pair, model: Float64[np.ndarray, "n 6"]) -> Float64[np.ndarray, "n 6"]:
    """Expected samples with the best constant; none for an unusable axis."""
    usable = pair.usable
    constant = np.where(usable, pair.real - model, 0.0).sum(axis=0) / np.maximum(usable.sum(axis=0), 1)
    return np.asarray(model + constant)


def noise_floor(logs: Sequence[WhitenedImu]) -> Float64[np.ndarray, "6"]:
    """Noise standard deviation of a sample by axis; neighbours stand in for an unusable one."""
    total, count = np.zeros(6), np.zeros(6)
    for log in logs:
        total += log.pair.axes * noise_std(log.whiten) ** 2
        count += log.pair.axes
    variance = total / np.maximum(count, 1.0)
    for part in (slice(0, 3), slice(3, 6)):
        known = count[part] > 0
        variance[part][~known] = variance[part][known].mean() if known.any() else LEAST_NOISE[part][0] ** 2
    return np.asarray(np.sqrt(variance))


def _residual(log: WhitenedImu, model: Float64[np.ndarray, "n 6"], part: slice) -> Float64[np.ndarray, " m"]:
    """Residual of usable held-out samples, within the band in which the reference is known."""
    pair, counts = log.pair, log.whiten.counts
    residual, rows = pair.real - model, pair.held_out[:: log.whiten.every]
    if log.whiten.band is not None:
        residual = log.whiten.band(residual)
    return np.asarray(residual[rows, part].ravel() if counts is None else residual[rows, part][counts[rows, part]])


def gains(logs: Sequence[WhitenedImu], before: Sequence[np.ndarray], after: Sequence[np.ndarray]) -> dict[str, Closer]:
    """Gain of all findings together by sensor, on held-out time."""
    noise, out = noise_floor(logs), {}
    for signal, k in known_sensors([log.pair for log in logs]).items():
        out[signal] = Closer.computed(held_out_rms(logs, before, after, k, ASCII_UNITS[signal]), sensor_noise(logs, noise, k))
    return out


def sensor_noise(logs: Sequence[WhitenedImu], floor: Float64[np.ndarray, "6"], k: int) -> float:
    """Root mean square noise of a sensor over its usable axes."""
    part, axes = slice(3 * k, 3 * k + 3), np.any([log.pair.axes for log in logs], axis=0)
    return float(np.sqrt(np.mean(floor[part][axes[part]] ** 2)))


def held_out_rms(
    logs: Sequence[WhitenedImu], before: Sequence[np.ndarray], after: Sequence[np.ndarray], k: int, unit: str
) -> HeldOut:
    """Root mean square residuals over held-out samples of a sensor; NaN where none are usable."""
    part = slice(3 * k, 3 * k + 3)
    rms = []
    for models in (before, after):
        residual = np.concatenate([_residual(log, model, part) for log, model in zip(logs, models, strict=True)])
        rms.append(float(np.sqrt((residual**2).mean())) if len(residual) else float("nan"))
    length = sum(float(log.pair.held_out.sum()) * log.pair.period_s for log in logs)
    return HeldOut(rms[0], rms[1], unit, round(length, 1))


def unexplained_residuals(
    logs: Sequence[WhitenedImu],
    after: Sequence[Float64[np.ndarray, "n 6"]],
    noises: Float64[np.ndarray, "6"],
    settings: HeldOutSettings,
) -> dict[str, Unexplained]:
    """Residuals by sensor with their noise; beside poses, blocks decide on whiteness."""
    out, beside_poses = {}, any(log.whiten.band is not None for log in logs)
    for signal, k in known_sensors([log.pair for log in logs]).items():
        held_out, noise = held_out_rms(logs, after, after, k, ASCII_UNITS[signal]), sensor_noise(logs, noises, k)
        part = slice(3 * k, 3 * k + 3)
        held_out_count = sum(len(_residual(log, model, part)) for log, model in zip(logs, after, strict=True))
        fitted_count = sum(log.count("fitted") for log in logs) / 2.0  # of both sensors
        most = settings.white_ratio
        if held_out_count:
            most = max(most, float(np.sqrt(fisher.isf(settings.few_samples_p_value, held_out_count, max(fitted_count, 1.0)))))
        white = held_out.rms_after < most * noise
        if not white and beside_poses:
            white = _p_value(logs, after, k, noise, settings) > settings.white_p_value
        out[signal] = Unexplained(held_out.rms_after, noise, white)
    return out


def _p_value(
    logs: Sequence[WhitenedImu], after: Sequence[Float64[np.ndarray, "n 6"]], k: int, noise: float, settings: HeldOutSettings
) -> float:
    """p-value of the power of held-out blocks under white noise (Student's t over blocks)."""
    powers: list[float] = []
    for log, model in zip(logs, after, strict=True):
        if not log.pair.axes[3 * k : 3 * k + 3].any():
            continue
        rows = log.pair.held_out[:: log.whiten.every]
        residual = log.pair.real - model if log.whiten.band is None else log.whiten.band(log.pair.real - model)
        power = (residual[rows, 3 * k : 3 * k + 3][:, log.pair.axes[3 * k : 3 * k + 3]] ** 2).mean(axis=1)
        block = np.floor(log.pair.stamp_s[:: log.whiten.every][rows] / settings.block_s).astype(int)
        powers += [float(power[block == number].mean()) for number in np.unique(block)]
    if len(powers) < 2:
        return 1.0
    return float(ttest_1samp(powers, (settings.white_ratio * noise) ** 2, alternative="greater").pvalue)


def known_sensors(pairs: Sequence[Pair]) -> dict[str, int]:
    """Sensors with a usable axis, and their index."""
    axes = np.any([pair.axes for pair in pairs], axis=0)
    return {signal: k for k, signal in enumerate(SENSORS) if axes[3 * k : 3 * k + 3].any()}
