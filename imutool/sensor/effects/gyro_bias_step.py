"""Step of the gyro's bias: + A from one moment on.

A shock, a jump of the temperature or a new initialisation shifts a bias: a change point (Page, Biometrika 42, 1955). Every
bias also walks, and a walk has its steepest moment, too: a step is the answer only where a jump at one time is likelier than
the likeliest walk (`imutool.noise.bias_walk`), for as many times as there are samples.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from imutool.array_types import Float64, Vectors
from imutool.sensor.effect import ONCE_MORE, Effect, Parameter, Stage, Theta, each_axis, residual
from imutool.sensor.samples import IdealMotion, SensorSamples
from imutool.units import Sensor

TREND_DEGREES = (0, 2)  # of time, fitted together with a step: a bias that also drifts hides when it steps
EDGE_S = 1.0  # of the log at both ends, where a few wrong samples look like a step
INDEPENDENT = 1e-9  # relative to the largest: smaller singular values are combinations of others


def bias_step(sensor: Sensor, unit: str, plausible: float) -> Effect:
    """Step of either sensor: A, then the time of the step (s from the log's start)."""

    def forward(samples: SensorSamples, theta: Theta) -> SensorSamples:
        return samples.with_added(sensor, np.outer(theta[:3], samples.stamp_s >= theta[3]).T)

    return Effect(
        f"{sensor}_bias_step",
        Stage.SENSOR,
        (sensor,),
        f"{sensor} += A from t_step on",
        (*each_axis(unit, plausible), Parameter("t_step", "s", 30.0, begins=True)),
        "the log goes on for some seconds before and after",
        forward,
        linear=False,
        starts=partial(_starts, 0 if sensor == "gyro" else 1, 0),
        alternatives=lambda samples: len(samples.stamp_s),
        of_time=True,
    )


def repeated(effects: Sequence[Effect]) -> Iterator[Effect]:
    """Effects with a second and third step of a bias that steps several times."""
    for effect in effects:
        yield effect
        if effect.name in ("gyro_bias_step", "accel_bias_step"):
            for before, variant in enumerate(ONCE_MORE, start=1):
                starts = partial(_starts, 0 if effect.sensors == ("gyro",) else 1, before)
                yield replace(effect, variant=variant, equation=f"{effect.equation} ({variant})", starts=starts)


def _starts(sensor: int, before: int, motion: IdealMotion, samples: SensorSamples) -> list[Theta]:
    """The likeliest step with so many likelier ones before it, with each trend."""
    error, t_s = residual(motion, samples)[sensor], samples.stamp_s
    others = followed(motion.sample(t_s, t_s))
    trends = (np.vander((t_s - t_s[0]) / np.ptp(t_s), degree + 1) for degree in TREND_DEGREES)
    return [likeliest_onset(t_s, error, np.concatenate([trend, others], axis=1), before) for trend in trends]


def followed(ideal: SensorSamples) -> Float64[np.ndarray, "n q"]:
    """Signals (scale, mount), their changes (clock), products of rates (an arm)."""
    products = np.stack([ideal.gyro[:, i] * ideal.gyro[:, j] for i in range(3) for j in range(i + 1)], axis=1)
    return np.concatenate(
        [ideal.gyro, ideal.accel, ideal.alpha, np.gradient(ideal.accel, ideal.stamp_s, axis=0), products], axis=1
    )


def likeliest_onset(
    t_s: Float64[np.ndarray, " n"],
    error: Vectors,
    beside: Float64[np.ndarray, "n q"],
    before: int = 0,
    setting_in: Sequence[Float64[np.ndarray, "_ a"]] = (),
) -> Theta:
    """Sizes by axis, then the time, of the onset that explains most of an error.

    A constant sets in, or signals of `setting_in`, between two samples, together with some columns and so many likelier
    constants. Of several signals an axis has a size for each; a signal of one column is that of all axes. Each axis counts by
    what is left there. In least squares further columns X gain left' X (X' X)^-1 X' left, all less their projection on the
    others (Frisch and Waugh, Econometrica 1933); for all columns that set in at one time these are sums from that time on.
    """
    columns = np.stack(setting_in or [np.ones((len(t_s), 1))], axis=2)
    basis = orthonormal(beside)
    size, row = _largest(t_s, error, basis, columns)
    for _ in range(before):
        step = (np.arange(len(t_s)) > row).astype(np.float64)
        step -= basis @ (basis.T @ step)
        basis = np.column_stack([basis, step / np.linalg.norm(step)])
        size, row = _largest(t_s, error, basis, columns)
    return np.append(size, (t_s[row] + t_s[row + 1]) / 2.0)


def orthonormal(beside: Float64[np.ndarray, "n q"]) -> Float64[np.ndarray, "n r"]:
    """Orthonormal basis of some columns."""
    left, singular, _ = np.linalg.svd(beside / np.maximum(np.linalg.norm(beside, axis=0), 1e-300), full_matrices=False)
    return np.asarray(left[:, singular > INDEPENDENT * singular[0]])


def _largest(
    t_s: Float64[np.ndarray, " n"],
    error: Vectors,
    basis: Float64[np.ndarray, "n q"],
    columns: Float64[np.ndarray, "n a m"],
) -> tuple[Theta, int]:
    """Sizes, axis by axis, of what explains most by setting in, after orthonormal columns, and the sample before it."""
    rest = error - basis @ (basis.T @ error)
    sizes, gain = list[Float64[np.ndarray, "n-1 _"]](), np.zeros(len(t_s) - 1)
    for x, left in zip(columns.transpose(1, 0, 2), np.split(rest, columns.shape[1], axis=1), strict=True):
        shared = from_on(basis[:, :, None] * x[:, None])
        N = from_on(x[:, :, None] * x[:, None]) - shared.transpose(0, 2, 1) @ shared
        each = np.arange(x.shape[1])
        minimum = np.maximum((x**2).mean(axis=0), np.finfo(np.float64).tiny)
        N[:, each, each] = (1.0 + INDEPENDENT) * np.maximum(N[:, each, each], minimum)  # few rows leave columns alike
        sums = from_on(x[:, :, None] * left[:, None])
        size = np.linalg.solve(N, sums)
        sizes.append(size.transpose(0, 2, 1).reshape(len(size), -1))
        gain += (sums * size / np.maximum((left**2).mean(axis=0), np.finfo(np.float64).tiny)).sum(axis=(1, 2))
    row = best_row(t_s, gain)
    return np.concatenate([size[row] for size in sizes]), row


def best_row(t_s: Float64[np.ndarray, " n"], gain: Float64[np.ndarray, " _"]) -> int:
    """The sample before the onset that gains most, but for the ends of the log."""
    return int(np.argmax(np.where((t_s[1:] > t_s[0] + EDGE_S) & (t_s[:-1] < t_s[-1] - EDGE_S), gain, 0.0)))


def from_on(x: Float64[np.ndarray, "n ..."]) -> Float64[np.ndarray, "n-1 ..."]:
    """Sums of the samples behind each but the last."""
    return np.asarray(np.cumsum(x[::-1], axis=0)[::-1][1:])


EFFECT = bias_step("gyro", "rad/s", 0.02)
