"""Bias model: a causal map from measured samples and a rest bias to the bias at each sample.

The *rest bias* differs from run to run (the turn-on bias); the dynamics start from it. The part that the motion adds (scale,
misalignment, curvature) belongs to the sensor. Models add the two, `bias = rest + ...`: an error of the rest bias is the same
error at every sample, so `imutool.bias_start.initial_bias` can solve for it with any model.

Inference is numpy. A trained method has a network in torch, `imutool.bias.networks.METHOD`, whose weights a model holds.
"""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Annotated, Any, ClassVar, NamedTuple, Protocol, Self, runtime_checkable

import msgspec
import numpy as np
from msgspec import UNSET

from imutool.array_types import Float64, Int64, Rows6, Vectors
from imutool.config import Settings
from imutool.units import SENSORS, Sensor

MAX_BIAS = 1e6  # rad/s and m/s²: more is no bias
STATISTICS = ("prior_mean", "prior_std", "truth_std", "rest_std", "walk_std", "noise_std")
GAP_S = 1.0  # a longer step of the stamps begins a new stretch: filters of the samples start anew, and no drift is integrated

Vector6 = Float64[np.ndarray, "6"]  # gyro (rad/s) then accel (m/s²)
Covariances = Float64[np.ndarray, "n 6 6"]
Array = Float64[np.ndarray, "..."]
Shapes = dict[str, tuple[int, ...]]
# Roots S of the covariance S S^T of the motion-dependent bias of samples (t_s, gyro, accel), by sensor; none where it is zero.
# The columns of S belong to the same unknowns at every sample: the covariance root of a mean is the mean of S.
CovarianceModel = Callable[[Array, Array, Array], Mapping[Sensor, Float64[np.ndarray, "n 3 p"]]]
TEMPERATURE_SHAPES: Shapes = {  # of the temperature in training: range (°C, K), mean terms, and the drift that it made
    **{f"temperature.{name}": (1,) for name in ("centre", "units")},
    "temperature.mean": (12,),
    **{f"temperature.{name}": (6,) for name in ("spread", "walk")},
}


@runtime_checkable
class Stream(Protocol):
    """Bias stream of a model over blocks of any size; it keeps its state between them."""

    def __call__(self, t_s: Float64[np.ndarray, " n"], gyro: Vectors, accel: Vectors) -> Rows6:
        """Bias at each sample from this and earlier samples only; block borders change nothing."""


class BiasEstimate(NamedTuple):
    """Bias at each sample, gyro (rad/s) then accel (m/s²), and its covariance."""

    bias: Rows6
    covariance: Covariances


@runtime_checkable
class RestBiasEstimator(Protocol):
    """Bias stream with the covariance of the rest bias, for blocks of any size."""

    def estimate(self, t_s: Float64[np.ndarray, " n"], gyro: Vectors, accel: Vectors) -> BiasEstimate:
        """Bias at each sample, and the covariance of its rest bias."""


@runtime_checkable
class SampleStream(Stream, Protocol):
    """Bias stream with a fast path for one sample; half of a block call is slicing."""

    def one(self, t_s: float, u: Vector6) -> Vector6:
        """Bias at one sample (gyro, then accel), as a block of this sample gives; the caller owns the array."""


@runtime_checkable
class DriftStream(SampleStream, Protocol):
    """Bias stream whose rest bias may drift."""

    @property
    def rest(self) -> Vector6:
        """Latest rest bias."""


class LogDrift(Protocol):
    """Drift of a bias that follows from the time in one log (`imutool.bias.temperature`)."""

    name: str  # of the channel

    def __call__(self, t_ns: Int64[np.ndarray, " n"]) -> Rows6:
        """Drift at some stamps: gyro (rad/s), then accel (m/s²)."""

    def covariance(self, t_ns: Int64[np.ndarray, " n"]) -> Covariances:
        """Covariance of the drift at some stamps, relative to its mean so far."""


class BiasModel(ABC):
    """Bias model with the statistics of its sensor's training runs, from which every run starts.

    It computes in float64; files store float32. `tensors` are the weights and statistics by name, with the shapes of `shapes`;
    missing ones are zero. `log_drift` is the drift in the log that the model is bound to; its streams take samples without
    this drift. `remarks` lists the reasons for a larger uncertainty. `load_before` is the load on the sensor before the log, if
    it was warm at the start (`imutool.bias_start.earlier_load`).
    """

    method: ClassVar[str]
    card: Mapping[str, Any]
    counts_samples = False  # instead of seconds: it works at one rate alone
    log_drift: LogDrift | None = None
    remarks: tuple[str, ...] = ()
    load_before: Float64[np.ndarray, "3 11"] | None = None

    def __init__(self, config: Settings, rate_hz: float, tensors: Mapping[str, np.ndarray] | None = None) -> None:
        self.config, self.rate_hz, self.card = config, rate_hz, {}
        blank = {name: np.zeros(shape) for name, shape in self.shapes(config).items() if name not in (tensors or {})}
        self.tensors = blank | {name: np.array(value, dtype=np.float64) for name, value in (tensors or {}).items()}

    def __repr__(self) -> str:
        name = str(self.card.get("name", self.method))
        return f"<bias model {name!r}: {self.method}, {f'{self.rate_hz:g} Hz' if self.rate_hz else 'any rate'}>"

    def at(self, rate_hz: float) -> Self:
        """Model for samples at another rate."""
        (out := copy.copy(self)).rate_hz = rate_hz
        return out

    @classmethod
    def shapes(cls, config: Settings) -> Shapes:
        """Shapes of the tensors by name; they need no memory, whatever sizes the settings give.

        Raises:
            ConfigError: settings that do not fit each other, or an unknown effect.
        """
        shapes: Shapes = dict.fromkeys(STATISTICS, (6,))
        return shapes | (TEMPERATURE_SHAPES if getattr(config, "temperature", UNSET) is not UNSET else {})

    @property
    def prior_mean(self) -> Vector6:
        """Mean of the rest bias over the training runs."""
        return self.tensors["prior_mean"]

    @property
    def prior_std(self) -> Vector6:
        """Spread of the rest bias from run to run."""
        return self.tensors["prior_std"]

    @property
    def truth_std(self) -> Vector6:
        """Spread of a rest bias estimated from `imutool.bias_start.bias_from_truth.TRUTH_S` seconds of truth."""
        return self.tensors["truth_std"]

    @property
    def rest_std(self) -> Vector6:
        """Spread of the bias at rest minus the bias in motion."""
        return self.tensors["rest_std"]

    @property
    def walk_std(self) -> Vector6:
        """Random walk of the rest bias per second^1/2."""
        return self.tensors["walk_std"]

    @property
    def noise_std(self) -> Vector6:
        """White noise of a sample from the residuals, for the covariance of the debiased message."""
        return self.tensors["noise_std"]

    def rest_dynamics(self) -> Float64[np.ndarray, "6 6"]:
        """Rest dynamics d(drift of the rest bias) / d(rest bias) per second; zero for most models."""
        return np.zeros((6, 6))

    def follows_load(self) -> bool:
        """Whether the bias drifts behind the sensor's load, for instance while it warms up."""
        return False

    def temperature_parameters(self) -> Mapping[Sensor, tuple[Array, Array]]:
        """Parameters of the drift with a log's temperature, and their covariance, by sensor."""
        return {}

    def calibration_covariance(self) -> CovarianceModel | None:
        """Covariance of the motion-dependent part as a root for each sample; None if unknown."""
        return None

    @abstractmethod
    def stretch(self, rest: Vector6, start_s: float = math.nan) -> Stream:
        """Bias stream from a rest bias over samples without gaps; one that drifts has `rest`, its latest rest bias.

        `start_s` is the time of the log's first sample (by default of the stretch's).
        """

    def stream(self, rest: Vector6) -> SampleStream:
        """Bias stream from a rest bias, for long logs and live use; a new stretch begins after a gap."""
        return _Stretches(self, rest)


class _Stretches:
    """Bias stream over stretches with gaps between them; each begins at the rest bias that the one before has reached."""

    def __init__(self, model: BiasModel, rest: Vector6) -> None:
        self._model, self._rest, self._start_s, self._before_s = model, rest, math.nan, math.nan
        self._stream = model.stretch(rest)
        self._one = getattr(self._stream, "one", None)

    def __call__(self, t_s: Float64[np.ndarray, " n"], gyro: Vectors, accel: Vectors) -> Rows6:
        """Bias at each sample."""
        if not len(t_s):
            return np.zeros((0, 6))
        if math.isnan(self._start_s):
            self._start_s = float(t_s[0])
        step = np.diff(t_s, prepend=self._before_s)
        self._before_s, cuts = float(t_s[-1]), np.flatnonzero((step > GAP_S) | (step < 0.0))
        if not len(cuts):
            return self._stream(t_s, gyro, accel)
        parts = []
        for first, last in zip([0, *cuts], [*cuts, len(t_s)], strict=True):
            if first in cuts:
                self._begin()
            if last > first:
                parts.append(self._stream(t_s[first:last], gyro[first:last], accel[first:last]))
        return np.concatenate(parts)

    def one(self, t_s: float, u: Vector6) -> Vector6:
        """Bias at one sample."""
        if not 0.0 <= t_s - self._before_s <= GAP_S and not math.isnan(self._before_s):
            self._begin()
        self._before_s, self._start_s = t_s, t_s if math.isnan(self._start_s) else self._start_s
        bias: Vector6 = self._stream(np.array([t_s]), u[None, :3], u[None, 3:])[0] if self._one is None else self._one(t_s, u)
        return bias

    def _begin(self) -> None:
        self._rest = getattr(self._stream, "rest", self._rest)
        before, self._stream = self._stream, self._model.stretch(self._rest, self._start_s)
        if take_over := getattr(self._stream, "continue_from", None):  # slow states outlast a gap
            take_over(before)
        self._one = getattr(self._stream, "one", None)


def matrices() -> Shapes:
    """Shapes of the matrix W of each sensor."""
    return {f"W.{sensor}": (3, 3) for sensor in SENSORS}


class Session(msgspec.Struct, frozen=True):
    """Session of one switching-on: stamps of its logs, and the rest bias of its next log."""

    start_ns: int
    end_ns: int
    mean: tuple[float, float, float, float, float, float]
    std: tuple[float, float, float, float, float, float]


class _Speed(msgspec.Struct, forbid_unknown_fields=True):
    speed_m_s: Annotated[float, msgspec.Meta(gt=0, le=1e4)]
    speed_correlation_s: Annotated[float, msgspec.Meta(gt=0, le=1e4)]


class _Priors(msgspec.Struct):
    """Entries of a card from which the start of a log is computed."""

    sessions: list[Session] = []
    turn_on_least_std: tuple[float, float, float, float, float, float] | None = None
    speed: _Speed | None = None
    turn_error: Annotated[float, msgspec.Meta(gt=0, le=1)] | None = None


def check_card(card: Mapping[str, Any]) -> None:
    """Refuse a card from an unknown source whose priors no sensor has.

    Raises:
        ValueError: another type, a negative or huge standard deviation, a huge mean, or no number.
    """
    try:
        found = msgspec.convert(card, _Priors)
    except msgspec.ValidationError as error:
        raise ValueError(str(error)) from error
    widths = [session.std for session in found.sessions] + [found.turn_on_least_std] * (found.turn_on_least_std is not None)
    numbers = np.array([*widths, *(session.mean for session in found.sessions)], float).reshape(-1, 6)
    if not (np.abs(numbers) <= MAX_BIAS).all() or (numbers[: len(widths)] < 0.0).any():
        raise ValueError("the card has an impossible prior")
