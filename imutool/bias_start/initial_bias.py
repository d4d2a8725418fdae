"""Initial bias of a run: the rest bias at its start, with standard deviation and source.

A measurement (at rest: `bias_at_rest`; from true poses: `bias_from_truth`) and the prior of the training logs are combined by
their variances, axis by axis; a measurement along one direction is a Kalman update. The prior is about the mean of the training
session within hours of the log, else of all sessions. The log decides on its width (`supported_std`, `widened`). A model may
add a motion-dependent part C(u): the measurement then uses the samples without that part.

With `auto` and `truth` the rest bias is tracked after the start, by every stop and by gravity in motion
(`imutool.bias_start.bias_tracking`): the bias of a sample depends on that sample and earlier ones. One exception: samples of
the measured stretch (up to the first stop's end, or the first seconds of truth) get the estimate from the whole stretch.
`smooth` uses the whole log for each sample.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from imutool.bias.log_binding import without_drift
from imutool.bias.model import (
    BiasModel,
    RestBiasEstimator,
    Stream,
    Vector6,
)
from imutool.bias.static import ConstantBiasStream
from imutool.bias_start.bias_tracking import (
    BiasTrajectory,
    Samples,
    TrackedBiasStream,
    TrajectoryBiasStream,
    filter_blocks,
    smooth_blocks,
)
from imutool.bias_start.prior_width import (
    USUAL_WALK,
    BiasPrior,
    LeastWidth,
    of_log,
    shown_bias,
    std_before,
    supported_std,
)
from imutool.bias_start.stretches import MAX, StretchClock, measured_rows
from imutool.errors import ConfigError, DataError
from imutool.inertial.inertial_filter import FilterSettings
from imutool.recording import Imu, seconds
from imutool.recording.columns import converted

AT_REST_STD = np.array([1e-4] * 3 + [0.03] * 3)  # earth's rotation; local gravity and a tilt of the sensor
MIN_STD = np.array([1e-6] * 3 + [1e-4] * 3)  # with a prior of zero variance nothing could be estimated
SESSION_GAP_S = 6 * 3600.0  # a longer pause is another switching-on
NOT_SWITCHED = 0.5  # probability that a sensor stayed on within these hours
PRIOR, TRACKED_BY = "prior of the training logs", "gravity in motion and every stop"
UNKNOWN_BODY = {"speed_m_s": 10.0, "speed_correlation_s": 0.5}  # with 3 m/s cars had twice the error, drones a twelfth less

METHODS = ("auto", "stationary", "prior", "truth")


class NoRestError(DataError):
    """No rest in the log, and an untrained model: nothing determines the bias."""


@dataclass(frozen=True, eq=False, repr=False)
class InitialBias:
    """Rest bias (gyro rad/s, accel m/s²) with standard deviation, and its source in words.

    It is valid for the whole log, unless `track` or `follows` is set. `track` is the rest bias over time. `follows` is the
    prior before the first sample: the rest bias is then tracked from `hold_s` seconds after the first sample, and before
    them it is `track` or `rest`. With `minimum`, the standard deviation of a prior lies between that and `std`.
    """

    rest: Vector6
    std: Vector6
    how: str
    noise: Vector6 = field(default_factory=lambda: np.zeros(6))  # of a sample, where it could be measured
    track: BiasTrajectory | None = None
    follows: BiasPrior | None = None
    hold_s: float = 0.0
    minimum: LeastWidth | None = None

    def __post_init__(self) -> None:
        for name in ("rest", "std", "noise"):
            if (value := converted(getattr(self, name), f"InitialBias.{name}")).shape != (6,):
                raise DataError(f"InitialBias.{name} is {value.dtype}{list(value.shape)}", expected="float64[6]")
            if not (np.isfinite(value).all() if name == "rest" else (value >= 0.0).all()):
                expected = "finite numbers" if name == "rest" else "numbers that are not negative"
                raise DataError(f"InitialBias.{name} is {value.tolist()}", expected=expected)
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        return f"InitialBias({self.how}: rest {self.rest.round(5).tolist()}, std {self.std.round(5).tolist()})"

    def stream(self, model: BiasModel) -> Stream:
        """Bias stream of a model from this start."""
        return self._tracked(model) or model.stream(self.rest)

    def estimator(self, model: BiasModel) -> RestBiasEstimator:
        """Bias stream of a model from this start, with the covariance of the rest bias."""
        return self._tracked(model) or ConstantBiasStream(model, self.rest, self.std)

    def _tracked(self, model: BiasModel) -> TrackedBiasStream | TrajectoryBiasStream | None:
        if self.follows is not None:
            track = self.track or BiasTrajectory(np.zeros(1), self.rest[None], self.std[None])
            return TrackedBiasStream(model, self.follows, track, self.hold_s)
        if self.track is not None:
            return TrajectoryBiasStream(model, self.track)
        return None

    @property
    def tracked(self) -> bool:
        """Whether the rest bias is tracked, rather than constant over the whole log."""
        return self.track is not None or self.follows is not None


def prior(model: BiasModel, first_ns: int | None = None) -> InitialBias:
    """Prior bias of a log that begins at a stamp: about the mean of its session, or of all.

    Within a session's hours the sensor may or may not have been switched on again: then its width is the most, else the least.
    """
    mean, std, minimum = model.prior_mean.copy(), model.prior_std.copy(), model.card.get("turn_on_least_std")
    sessions = [] if first_ns is None else model.card.get("sessions", [])
    distance_ns = [max(0, session["start_ns"] - first_ns, first_ns - session["end_ns"]) for session in sessions]
    if distance_ns and min(distance_ns) <= SESSION_GAP_S * 1e9:
        session = sessions[distance_ns.index(min(distance_ns))]
        mean, repeated = np.array(session["mean"]), LeastWidth(np.array(session["std"]), NOT_SWITCHED)
        return InitialBias(mean, np.maximum(std, repeated.std), PRIOR, minimum=repeated)
    return InitialBias(mean, std, PRIOR, minimum=None if minimum is None else LeastWidth(np.array(minimum)))


def bias_prior(model: BiasModel, first_ns: int | None = None) -> BiasPrior:
    """Prior of the bias filter from the training logs; a sensor's axes share one random walk."""
    start = prior(model, first_ns)
    ground = np.maximum(model.rest_std, AT_REST_STD)
    walk = np.repeat(np.sqrt(np.mean(model.walk_std.reshape(2, 3) ** 2, axis=1)), 3)
    walk = np.where(walk > 0, walk, USUAL_WALK)
    minimum = None if start.minimum is None else start.minimum._replace(std=np.maximum(start.minimum.std, MIN_STD))
    speed = model.card.get("speed", {} if "logs" in model.card else UNKNOWN_BODY)
    settings = FilterSettings(gyro_scale=model.card.get("turn_error", FilterSettings().gyro_scale), **speed)
    return BiasPrior(start.rest, np.maximum(start.std, MIN_STD), ground, walk, minimum, settings)


def tracked_from_prior(model: BiasModel, first_ns: int | None = None) -> InitialBias:
    """Prior bias, tracked from the first sample on: for a live node, which cannot look ahead."""
    start = prior(model, first_ns)
    std = std_before(start.std, start.minimum)
    how = f"{training_source(model)}, {accuracy(std)}, then {TRACKED_BY}"
    return InitialBias(start.rest, std, how, follows=bias_prior(model, first_ns))


def tracked_in_motion(model: BiasModel, imu: Imu) -> InitialBias:
    """Prior bias, tracked from the first sample on; for a log that does not stop.

    Of another unit's log it is the bias that these samples show, smoothed.
    """
    first_ns = int(imu.t_ns[0]) if len(imu) else 0
    before, samples = bias_prior(model, first_ns), relative_samples(imu)
    found = smooth_bias(model, [samples], before)
    track, other = found.track, of_log(before, found.difference, found.variance, AT_REST_STD)
    if other is before:
        return tracked_from_prior(model, first_ns)
    how = f"gravity in motion, as of another unit, {accuracy(track.std[0])}, then {TRACKED_BY}"
    return InitialBias(track.rest[0], track.std[0], how, track=track, follows=other, hold_s=float(samples[0][-1]))


def smoothed_start(model: BiasModel, batches: Iterable[Samples], before: BiasPrior, where: str = "") -> InitialBias:
    """Smoothed rest bias in time, by all stops, gravity in motion and the training logs.

    `batches` are seconds since the first sample, gyro and accel; they are iterated again if the log contradicts the prior.

    Raises:
        DataError: less than half a second of samples.
        NoRestError: an untrained model, and a log that never rests.
    """
    track, rested_s, *_ = smooth_bias(model, batches, before)
    if not len(track.t_s):
        raise DataError("too short to be smoothed", where=where, expected="at least half a second of samples")
    if not model.card and not rested_s:
        raise NoRestError("the log never rests", where=where, expected="1.5 s or more without motion")
    std = np.median(track.std, axis=0)
    parts = [f"{rested_s:.1f} s at rest in all"] * (rested_s > 0) + ["gravity in motion"]
    parts += [training_source(model)] * bool(model.card)
    return InitialBias(track.rest[0], std, f"{', '.join(parts)}, {accuracy(std)}, forward and backward", track=track)


def from_numbers(text: str) -> InitialBias:
    """Initial bias from six numbers in text: gx,gy,gz in rad/s, ax,ay,az in m/s².

    Raises:
        ConfigError: neither six numbers that a sensor can read nor a name of `METHODS`.
    """
    try:
        rest = np.array([float(word) for word in text.split(",")])
    except ValueError:
        rest = np.zeros(0)
    if rest.shape != (6,) or not (np.abs(rest) <= MAX).all():
        raise ConfigError(f"{text!r}", where="init", expected=f"{', '.join(METHODS)}, truth:SECONDS or gx,gy,gz,ax,ay,az")
    return InitialBias(rest, np.zeros(6), "given")


def training_source(model: BiasModel) -> str:
    """Source of the model's prior in words."""
    if not model.card or "prior" in model.card:  # a model that was not trained names the source of its bias
        return str(model.card.get("prior", "zero, as an untrained model has no prior"))
    logs = model.card.get("logs", ())
    return f"prior of {len(logs)} logs" if isinstance(logs, list | tuple) and len(logs) > 1 else PRIOR


def accuracy(std: Vector6) -> str:
    """Standard deviation of the least accurate gyro axis in words."""
    minute = np.format_float_positional(np.degrees(60.0 * std[:3].max()), precision=2, fractional=False, trim="-")
    return f"±{std[:3].max():.1g} rad/s ({minute}° a minute)"


def relative_samples(imu: Imu) -> Samples:
    """Measured samples with seconds since the first; a long gap counts as `MAX_GAP_S`."""
    imu = measured_rows(imu)
    return seconds(StretchClock()(imu.t_ns), int(imu.t_ns[0]) if len(imu) else 0), imu.gyro, imu.accel


def model_samples(model: BiasModel, imu: Imu) -> Samples:
    """Samples as `relative_samples`, without the drift that the model follows in their log."""
    return relative_samples(without_drift(model, measured_rows(imu)))


class SmoothedBias(NamedTuple):
    """Smoothed rest bias, time at rest, and what the log alone shows of the bias at its start."""

    track: BiasTrajectory
    rested_s: float
    difference: Vector6  # of that bias from the prior's mean
    variance: Vector6  # of it: infinite where the log shows little


def smooth_bias(model: BiasModel, batches: Iterable[Samples], prior: BiasPrior) -> SmoothedBias:
    """Smoothed rest bias over some samples; memory: thirteen numbers per block.

    The samples decide on the prior's width: they are iterated again if they contradict it. The trajectory is empty for less
    than a block.
    """
    found = _smoothed(model, batches, prior)
    used = of_log(prior, found.difference, found.variance, AT_REST_STD)
    if used is prior:
        used = replace(prior, std=supported_std(prior.std, prior.minimum, found.difference, found.variance))
    kept = np.array_equal(used.std, prior.std) and used.mean is prior.mean
    return found if kept else found._replace(track=_smoothed(model, batches, used).track)


def _smoothed(model: BiasModel, batches: Iterable[Samples], prior: BiasPrior) -> SmoothedBias:
    rows, rested_s, first = [], 0.0, None
    for block, state in smooth_blocks(filter_blocks(model, batches, prior)):
        first = state if first is None else first
        std = np.sqrt(np.diag(state.covariance(block.resting)))
        rows.append(np.concatenate([[block.start_s], state.rest_bias(block.resting), std]))
        rested_s += (block.end_s - block.start_s) * block.resting
    table = np.array(rows).reshape(-1, 13)
    shown = np.zeros(6), np.full(6, np.inf)
    if first is not None:
        shown = shown_bias(first.bias, np.diag(first.covariance(False)), prior.mean, prior.std**2)
    return SmoothedBias(BiasTrajectory(table[:, 0], table[:, 1:7], table[:, 7:]), rested_s, *shown)
