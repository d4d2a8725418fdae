"""Correct IMU samples with a bias model: all in memory, or one at a time.

Causal: after the initial bias, the bias at a sample depends on that sample and earlier ones.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from functools import partial
from operator import index
from typing import NamedTuple, Self

import numpy as np

from imutool.array_types import Bool, Float64, Rows6, Vectors
from imutool.bias.log_binding import OnlineDrift, at_rate, bound
from imutool.bias.model import GAP_S, BiasModel, SampleStream, Stream, Vector6
from imutool.bias_start.bias_covariance import BiasEstimator
from imutool.bias_start.initial_bias import InitialBias, model_samples, tracked_from_prior
from imutool.bias_start.stretches import MAX, MIN_FORCE_M_S2, measured, unusual_gravity
from imutool.errors import ConfigError, DataError
from imutool.recording import MIN_PERIOD_S, Imu, Times, nanoseconds
from imutool.recording.columns import MAX_GAP_S, median
from imutool.units import FULL_SCALE_RAD_S

USUAL_MAX = np.minimum(MAX, [FULL_SCALE_RAD_S] * 3 + [np.inf] * 3)
CHECKED = 400  # first samples of a stream whose rate and gravity are checked: 2 s at 200 Hz
logger = logging.getLogger(__name__)

GAP_NS, MAX_GAP_NS = nanoseconds(GAP_S), nanoseconds(MAX_GAP_S)
BLOCK_SAMPLES = 1 << 14  # corrected at once: a covariance has 288 bytes


class DebiasedImu(NamedTuple):
    """Corrected samples and the subtracted bias: gyro (rad/s), then accel (m/s²)."""

    imu: Imu
    bias: Rows6


def apply(model: BiasModel, start: InitialBias, imu: Imu) -> DebiasedImu:
    """Corrected samples and bias of a model, computed in blocks, as for a log."""
    good, samples, stream = measured(imu.gyro, imu.accel), model_samples(model, imu), start.stream(model)
    bias = np.empty((len(samples[0]), 6))
    for rows in _blocks(len(bias)):
        bias[rows] = stream(*(column[rows] for column in samples))
    bias = _with_drift(model, imu, _to_all(good, bias))
    return _debiased(imu, bias)


def corrected(model: BiasModel, start: InitialBias, imu: Imu) -> Imu:
    """Corrected samples as `apply`, whose bias takes as much memory again."""
    samples, stream = model_samples(model, imu), start.stream(model)
    if len(samples[0]) < len(imu):  # the bias of a sample that is no measurement is that of another
        return apply(model, start, imu).imu
    gyro, accel = imu.gyro.copy(), imu.accel.copy()
    for rows in _blocks(len(imu)):
        bias = _with_drift(model, imu.rows(rows), stream(*(column[rows] for column in samples)))
        gyro[rows] -= bias[:, :3]
        accel[rows] -= bias[:, 3:]
    return _imu(imu.t_ns, gyro, accel)


def apply_with_std(model: BiasModel, start: InitialBias, imu: Imu) -> tuple[DebiasedImu, Rows6]:
    """Corrected samples as `apply`, and the bias' deviation: gyro (rad/s), then accel (m/s²)."""
    estimator = BiasEstimator(model, start)
    good, (t_s, gyro, accel) = measured(imu.gyro, imu.accel), model_samples(model, imu)
    t_ns = imu.t_ns[good]
    bias, std = np.empty((len(t_s), 6)), np.empty((len(t_s), 6))
    for rows in _blocks(len(t_s)):
        bias[rows], covariance = estimator(t_s[rows], gyro[rows], accel[rows])
        if model.log_drift is not None:
            covariance += model.log_drift.covariance(t_ns[rows])
        std[rows] = np.sqrt(covariance.diagonal(axis1=1, axis2=2))
    bias, std = _with_drift(model, imu, _to_all(good, bias)), _to_all(good, std)
    return _debiased(imu, bias), std


def _debiased(imu: Imu, bias: Rows6) -> DebiasedImu:
    return DebiasedImu(_imu(imu.t_ns, imu.gyro - bias[:, :3], imu.accel - bias[:, 3:]), bias)


def _imu(t_ns: Times, gyro: Vectors, accel: Vectors) -> Imu:
    """Samples of columns that nobody else has."""
    for column in (gyro, accel):  # so that the samples need no copy
        column.flags.writeable = False
    return Imu(t_ns, gyro, accel)


def _blocks(count: int) -> Iterator[slice]:
    for first in range(0, count, BLOCK_SAMPLES):
        yield slice(first, first + BLOCK_SAMPLES)


def _with_drift(model: BiasModel, imu: Imu, bias: Rows6) -> Rows6:
    """Bias of the samples as recorded, from that of the samples without the drift."""
    return bias if model.log_drift is None else bias + model.log_drift(imu.t_ns)


def _to_all(good: Bool[np.ndarray, " n"], values: Float64[np.ndarray, "m 6"]) -> Rows6:
    """Values of the measured samples for all samples: one that is no measurement has the value before it."""
    if good.all():
        return values
    if not len(values):
        return np.zeros((len(good), 6))
    return np.asarray(values[np.maximum(np.cumsum(good) - 1, 0)])


class OnlineDebiaser:
    """Corrects IMU samples one at a time, for a live node.

    `start` is a bias of `imutool.bias_at_rest`, over the first seconds for instance. Without `start` it begins at the prior and
    tracks the rest bias, as `init="auto"` does. If the model's bias follows the temperature, give it (°C) with the samples that
    have one. With `with_covariance` each sample has a `covariance`, for an estimator of yours, and takes longer.

    Raises:
        ConfigError: another type, or the covariance of a model that follows the temperature.
    """

    def __init__(self, model: BiasModel, start: InitialBias | None = None, *, with_covariance: bool = False) -> None:
        given: tuple[object, object] = model, start
        if not isinstance(given[0], BiasModel):
            what = f"is of type {type(given[0]).__name__}"
            raise ConfigError(what, where="model", expected="a loaded model", fix="Load it with `imutool.load_model`")
        if not isinstance(given[1], InitialBias | None):
            what = f"is of type {type(given[1]).__name__}"
            raise ConfigError(what, where="start", expected="a bias of `imutool.bias_at_rest`, or None")
        self._model, self._start, self._begun = model, start, False
        self._start_ns, self._before_ns, self._bias = 0, 0, np.zeros(6)
        self._u, self._maximum, self._left_out = np.full(6, np.nan), USUAL_MAX, 0
        self._drift = OnlineDrift(model) if model.temperature_parameters() else None
        self._first: list[tuple[int, Float64[np.ndarray, "3"]]] | None = []  # None once they are checked
        self._with_covariance, self._covariance = with_covariance, np.full((6, 6), np.nan)
        if with_covariance and self._drift is not None:
            raise ConfigError("the model follows the temperature", where="with_covariance", expected="another model, or False")

    def __repr__(self) -> str:
        """The model, and what was subtracted last."""
        last = f"last bias {np.array2string(self._bias, precision=5)}" if self._begun else "no sample yet"
        return f"<online debiaser of {self._model!r}: {last}>"

    def __copy__(self) -> Self:
        """Copy with a stream of its own."""
        return deepcopy(self)

    def __call__(
        self,
        stamp_ns: int,
        gyro: Float64[np.ndarray, "3"] | Sequence[float],
        accel: Float64[np.ndarray, "3"] | Sequence[float],
        temperature: float | None = None,
    ) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"], Float64[np.ndarray, "6"]]:
        """Corrected angular rate (rad/s), specific force (m/s²), and the subtracted bias.

        A sample that is no measurement (NaN, for instance), or the one before again, changes nothing: the bias is that of the
        sample before.

        Args:
            stamp_ns: Time of the sample in nanoseconds, on any clock.
            gyro: Measured angular rate (rad/s).
            accel: Measured specific force (m/s²); at rest it is +g up.
            temperature: Of the sensor (°C), for a model that follows it.

        Raises:
            DataError: not one sample of three and three values, a stamp that is not an integer, or first samples whose stamps
                are not in nanoseconds, or never set.
            ModelError: first samples at another rate than the model's training logs.
        """
        try:
            u, stamp_ns = np.concatenate((gyro, accel), dtype=np.float64, casting="safe"), index(stamp_ns)
        except (TypeError, ValueError):
            u = np.zeros(0)
        if u.shape != (6,) or len(gyro) != 3:
            what = f"gyro and accel of shape {list(np.shape(gyro))}, {list(np.shape(accel))} at {stamp_ns!r:.60}"
            raise DataError(what, where="OnlineDebiaser", expected="one sample of 3 numbers each, at integer nanoseconds")
        size = np.abs(u)
        measured = (size <= self._maximum).all()  # false for NaN
        if not measured and (size <= MAX).all():
            logger.warning("OnlineDebiaser: gyro looks like deg/s, not rad/s: it reaches %.4g", size[:3].max())
            measured, self._maximum = True, MAX
        repeats = stamp_ns == self._before_ns and np.array_equal(u, self._u)
        if measured and size[3:].max() >= MIN_FORCE_M_S2 and not repeats:
            self._u = u
            if self._first is not None:
                self._check_first(stamp_ns, u[3:])
            if self._drift is None:
                t_s = self._seconds(stamp_ns)
                self._bias = self._correct(t_s, u)
            else:
                self._warn_without(stamp_ns, temperature)
                drift, t_s = self._drift(stamp_ns, temperature), self._seconds(stamp_ns)
                self._bias = self._correct(t_s, u - drift) + drift
        elif not repeats:
            self._left_out += 1
            if self._left_out == CHECKED and not self._begun:
                logger.warning("OnlineDebiaser: no sample of the first %d is a measurement: nothing is subtracted", CHECKED)
        bias = self._bias.copy()
        clean = u - bias
        return clean[:3], clean[3:], bias

    @property
    def covariance(self) -> Float64[np.ndarray, "6 6"]:
        """Covariance of the last bias: gyro (rad/s), then accel (m/s²); NaN before the first measured sample.

        The white noise of a sample is not in it.

        Raises:
            ConfigError: the debiaser was not made with `with_covariance`.
        """
        if not self._with_covariance:
            raise ConfigError("it is not computed", where="covariance", expected="OnlineDebiaser(..., with_covariance=True)")
        return self._covariance.copy()

    def _check_first(self, stamp_ns: int, accel: Float64[np.ndarray, "3"]) -> None:
        """Check rate and gravity once, by the first samples; they may come in batches, or a moment late."""
        assert self._first is not None
        self._first.append((stamp_ns, accel))
        if len(self._first) < CHECKED:
            return
        first, self._first = self._first, None
        t_ns, counts = np.unique(np.array([stamp_ns for stamp_ns, _ in first], np.int64), return_counts=True)
        steps = np.diff(t_ns) * 1e-9
        periods = [float(steps.mean()), float(median(steps))] if len(steps) else [0.0]
        if max(periods) < MIN_PERIOD_S:
            what = f"the first {len(first)} samples have {len(t_ns)} stamps, {max(periods) * 1e9:.3g} ns apart"
            what = (
                f"{what}: the stamps are not in nanoseconds" if len(steps) else f"the first {len(first)} samples have one stamp"
            )
            raise DataError(what, where="OnlineDebiaser", expected=f"steps of at least {MIN_PERIOD_S * 1e9:.0f} ns")
        if repeated := len(first) - len(t_ns):
            what = "OnlineDebiaser: %d of the first %d samples have the stamp of another: give each its own time"
            logger.warning(what, repeated, len(first))
            periods.append(float(t_ns[-1] - t_ns[0]) * 1e-9 / int(counts[:-1].sum()))
        rates = [1.0 / period_s for period_s in periods]
        rate_hz = min(rates, key=lambda hz: abs(hz - (self._model.rate_hz or hz)))
        at_rate(self._model, rate_hz, "OnlineDebiaser")  # without `force` it is the same model, or refused
        if wrong := unusual_gravity(np.array([accel for _, accel in first])):
            logger.warning("OnlineDebiaser: %s", wrong)

    def _warn_without(self, stamp_ns: int, temperature: float | None) -> None:
        """Warn of a first sample without temperature; the rest bias then varies as much as the drift did in training."""
        if not self._begun and temperature is None:
            self._model = bound(self._model, {}, "", stamp_ns, stamp_ns)
            logger.warning("live stream: %s", "; ".join(self._model.remarks))

    def _seconds(self, stamp_ns: int) -> float:
        """Seconds since the first sample; a jump of the clock counts as at most `stretches.MAX_GAP_S`."""
        if not self._begun:
            self._begun, self._start_ns, self._before_ns = True, stamp_ns, stamp_ns
            self._correct = self._correction(self._start or tracked_from_prior(self._model, stamp_ns))
        step_ns = stamp_ns - self._before_ns
        if -GAP_NS < step_ns < 0:  # out of order: no time passes
            self._start_ns += step_ns
        elif not 0 <= step_ns <= MAX_GAP_NS:
            self._start_ns += step_ns - MAX_GAP_NS
        self._before_ns = stamp_ns
        return (stamp_ns - self._start_ns) * 1e-9

    def _correction(self, start: InitialBias) -> Callable[[float, Vector6], Vector6]:
        """Bias at one sample, from a start."""
        if self._with_covariance:
            return partial(self._estimated, BiasEstimator(self._model, start))
        stream = start.stream(self._model)
        return stream.one if isinstance(stream, SampleStream) else partial(_one_as_block, stream)

    def _estimated(self, estimator: BiasEstimator, t_s: float, u: Vector6) -> Vector6:
        """Bias at one sample; its covariance is kept."""
        bias, covariance = estimator(np.array([t_s]), u[None, :3], u[None, 3:])
        self._covariance = covariance[0]
        return np.asarray(bias[0])


def _one_as_block(stream: Stream, t_s: float, u: Vector6) -> Vector6:
    """Bias at one sample, of a stream without a path for single samples."""
    bias: Vector6 = stream(np.array([t_s]), u[None, :3], u[None, 3:])[0]
    return bias
