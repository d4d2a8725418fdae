"""Models bound to one log or stream: to its rate, and to its temperature."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from imutool.array_types import Float64, Int64, Rows6, Vectors
from imutool.bias.model import BiasModel, Covariances, Vector6
from imutool.bias.temperature import TemperatureFilter, celsius_of, channel_of, holding, scale_of
from imutool.cleaning.likelihood import axis_names, signed_permutations
from imutool.errors import ModelError
from imutool.inertial.stationary import CALM, white_noise
from imutool.mcap_io.temperature import EVERY_NS, is_temperature, thinned
from imutool.recording import Imu, Scalars
from imutool.recording.columns import quantile
from imutool.sensor.signals import TEMPERATURE_TERMS
from imutool.units import COLUMNS

RATE_TOLERANCE = 0.05  # a real rate differs from its nominal one by a few per mille (BMI160: 199.4 for 200)
MAX_FACTOR = 4.5  # between the rates of training and log: four, as means of four samples were tried, and some drift
BATCHES = "The stamps come in batches: imutool convert LOG OUT --restamp puts them on the clock of the sensor"
MAX_AGE_S = 60.0  # of a number of the channel: a case warms within minutes
SET_BACK = 2  # half seconds: further back the clock was set, and the sample is not late
WALK_NS = 10_000_000_000  # between two numbers of a drift, from which its walk is taken
MAX_NOISE = 4.0  # ratio to the residuals of the training logs; training logs up to 2.0
MAX_RATE = 0.01  # relative difference of rates: it changes a conv with random weights by 5 %, one that ships by nothing
SURE = 3.0  # deviations of a median step
MAX_BEYOND_K = 1.0  # beyond the trained range, before it counts as another one
TURNED = 20.0  # chi-square that turned axes leave at most, and by which they are better
MAX_LEFT = 0.2  # share of chi-square that turned axes leave; of sensors that were turned up to 0.16, by chance 0.28
FEW_SESSIONS, MAX_LEFT_OF_FEW = 3, 0.12  # few say little of the next one; TUM-VI's turned sensor, of one session, leaves 0.11
Stamps = Int64[np.ndarray, " n"]


def at_rate(model: BiasModel, rate_hz: float, where: object, t_ns: Stamps | None = None, *, force: bool = False) -> BiasModel:
    """Model for samples at a rate; within 5 % of that of its training it is the model itself.

    With `force` another rate may be as far away as `MAX_FACTOR`: filters and drifts have their times in seconds. The times of
    the samples show stamps in batches.

    Raises:
        ModelError: another rate without `force`, or too far away, a model that counts samples, or stamps in batches.
    """
    if not model.rate_hz or abs(rate_hz / model.rate_hz - 1) < RATE_TOLERANCE:
        return model
    mean_hz = 1e9 * (len(t_ns) - 1) / max(int(t_ns[-1] - t_ns[0]), 1) if t_ns is not None else 0.0
    batches = abs(mean_hz / model.rate_hz - 1) < RATE_TOLERANCE
    possible = not (batches or model.counts_samples) and 1 / MAX_FACTOR < rate_hz / model.rate_hz < MAX_FACTOR
    if possible and force:
        out = model.at(rate_hz)
        out.remarks = (*model.remarks, f"samples at {rate_hz:.2f} Hz, in the training logs at {model.rate_hz:.2f} Hz")
        return out
    what = f"IMU at {rate_hz:.1f} Hz{f' by most of its steps, and {mean_hz:.1f} Hz in the mean' if batches else ''}"
    expected = f"{model.rate_hz:.1f} Hz, at which model {model.card.get('name', model.method)!r} was trained"
    fix = BATCHES if batches else "Choose or train a model for this sensor"
    if possible:
        fix += f", or use it at this rate with `force` (an OnlineDebiaser with `model.at({rate_hz:.0f})`)"
    raise ModelError(what, where=where, expected=expected, fix=fix)


def other_conditions(model: BiasModel, samples: tuple[Float64[np.ndarray, " n"], Vectors, Vectors]) -> list[str]:
    """Sentences on noise and rate of some samples that the training logs did not have."""
    sentences = []
    steps = np.diff(samples[0])
    margin = min(0.5, 0.5 * SURE / math.sqrt(len(steps)))  # of the median's rank, however the steps scatter
    shortest, period_s, longest = (float(quantile(steps, share)) for share in (0.5 - margin, 0.5, 0.5 + margin))
    noise = CALM * white_noise(np.concatenate([samples[1], samples[2]], axis=1), period_s)
    known = model.noise_std > 0
    ratio = float((noise[known] / model.noise_std[known]).max()) if known.any() else 0.0
    if ratio > MAX_NOISE:  # less noise is no doubt: a drone in the hand has a tenth of that in flight
        sentences.append(f"the samples are {ratio:.0f} times as noisy as in the training logs: another sensor, or vibration")
    if model.rate_hz and not (1.0 - MAX_RATE) / longest < model.rate_hz < (1.0 + MAX_RATE) / shortest:
        sentences.append(f"samples at {1.0 / period_s:.2f} Hz, in the training logs at {model.rate_hz:.2f} Hz")
    return sentences


def other_unit(model: BiasModel, about: Mapping[str, str]) -> Iterator[str]:
    """Sentences on a log that names another origin than the model's."""
    for key, words in (("sensor", "sensor"), ("dataset", "data set")):
        own, other = model.card.get(key), about.get(key)
        if own and other and own != other:
            yield f"the model was made for the {words} {own}, the log is of {other}"


def max_left(sessions: int) -> float:
    """Share of chi-square that turned axes leave at most, by the known sessions."""
    return MAX_LEFT_OF_FEW if 1 <= sessions <= FEW_SESSIONS else MAX_LEFT


def turned_axes(difference: Vector6, std: Vector6, mean: Vector6, max_left: float, *, confirmed: bool = False) -> list[str]:
    """Sentence on a log whose bias is clearly that of the training logs in turned axes.

    A correction of scales is the same in axes that are turned by half a turn, so the share of it says nothing about these. If
    it is `confirmed`, there are no other turns. `max_left` is the share of chi-square that turned axes leave at most: less,
    where few logs show how much the bias changes by itself.
    """
    rotations = signed_permutations()[np.linalg.det(signed_permutations()) > 0.0]  # the identity first
    if confirmed:
        rotations = rotations[(np.abs(rotations) == np.eye(3)).all(axis=(1, 2))]
    turned = (rotations[:, None] @ mean.reshape(2, 3, 1)).reshape(-1, 6)
    chi_square = (((mean + difference - turned) / std) ** 2).sum(axis=1)
    best = int(np.argmin(chi_square))
    if chi_square[best] > min(TURNED, max_left * chi_square[0]) or chi_square[0] - chi_square[best] < TURNED:
        return []
    return [
        f"its bias is that of the training logs if its x, y, z are their {axis_names(rotations[best])}: the axes are turned"
    ]


class TemperatureDrift:
    """Drift of a model's bias in one log, by its stamps."""

    def __init__(self, model: BiasModel, channel: Scalars, name: str) -> None:
        self.name, self._t_ns = name, channel.t_ns
        scale = scale_of(model)
        terms, beyond = scale.terms(channel), scale.beyond(channel)
        self._within = terms - beyond
        self._by_sensor = model.temperature_parameters()
        self._bias, self._beyond = np.zeros((2, len(terms), 6))
        for sensor, (theta, _) in self._by_sensor.items():
            K = theta.reshape(3, TEMPERATURE_TERMS).T
            self._bias[:, COLUMNS[sensor]] = terms @ K
            self._beyond[:, COLUMNS[sensor]] = beyond @ K

    def __call__(self, t_ns: Int64[np.ndarray, " n"]) -> Rows6:
        """Drift at some stamps: gyro (rad/s), then accel (m/s²)."""
        return np.asarray(self._bias[holding(self._t_ns, t_ns)])

    def beyond(self, start_ns: int, end_ns: int) -> tuple[Vector6, Vector6]:
        """Size of the drift beyond the trained range in a log, and its walk in a second^1/2."""
        rows = holding(self._t_ns, np.arange(start_ns, end_ns + 1, WALK_NS))
        drift = self._beyond[rows]
        walk = np.sqrt((np.diff(drift, axis=0) ** 2).mean(axis=0) * (1e9 / WALK_NS)) if len(rows) > 1 else np.zeros(6)
        return np.sqrt((drift**2).mean(axis=0)), walk

    def covariance(self, t_ns: Int64[np.ndarray, " n"]) -> Covariances:
        """Covariance of the drift relative to its mean so far.

        The mean acts like a rest bias, and counts in its covariance (`imutool.bias_start.bias_covariance`), as does what the
        drift has beyond the trained range (`bound`).
        """
        out, rows = np.zeros((len(t_ns), 6, 6)), holding(self._t_ns, t_ns)
        if not len(rows):
            return out
        row, place = np.unique(rows, return_inverse=True)
        means = np.cumsum(self._within[: row[-1] + 1], axis=0)[row] / (row + 1.0)[:, None]
        off = self._within[row] - means
        for sensor, (_, covariance) in self._by_sensor.items():
            blocks = covariance.reshape(3, TEMPERATURE_TERMS, 3, TEMPERATURE_TERMS)
            S = np.einsum("nq,iqjr,nr->nij", off, blocks, off, optimize=True)
            out[:, COLUMNS[sensor], COLUMNS[sensor]] = S[place]
        return out


class OnlineDrift:
    """Drift of a model's bias in a live stream; zero before the first temperature."""

    def __init__(self, model: BiasModel) -> None:
        scale = scale_of(model)
        self._follow, self._mean = TemperatureFilter(scale.centre, scale.half_range), scale.mean
        self._K = {
            sensor: theta.reshape(3, TEMPERATURE_TERMS).T for sensor, (theta, _) in model.temperature_parameters().items()
        }
        self._half_second, self._bias = -(2**63), np.zeros(6)

    def __call__(self, t_ns: int, temperature: float | None) -> Vector6:
        """Drift from a sample on; its temperature is in °C or kelvin, None if it has none."""
        half_second = t_ns // EVERY_NS
        is_new = half_second > self._half_second or half_second < self._half_second - SET_BACK
        if temperature is not None and math.isfinite(temperature) and is_new:
            self._half_second = half_second
            terms = self._follow(t_ns, celsius_of(temperature)) - self._mean
            for sensor, K in self._K.items():
                self._bias[COLUMNS[sensor]] = terms @ K
        return self._bias


def bound(model: BiasModel, scalars: Mapping[str, Scalars], imu_topic: str, start_ns: int, end_ns: int) -> BiasModel:
    """Model with its drift in one log; the model itself where it follows no temperature.

    Without a channel there is no drift, and the rest bias varies as much as the drift did in training. Beyond the trained range
    it varies as much as the drift does there. `remarks` say so, and what else makes the drift less sure.
    """
    if not model.temperature_parameters():
        return model
    scale, out = scale_of(model), copy.copy(model)
    low, high = scale.centre - scale.half_range, scale.centre + scale.half_range
    trained = f"{scale.channel}, {low:.1f} to {high:.1f} °C in training"
    found = channel_of(scalars, imu_topic, scale.channel)
    if found is None:
        several = [name for name in scalars if is_temperature(name)]
        what = f"none of {', '.join(several)} is named as the IMU's temperature" if several else "there is no temperature"
        out.remarks = (*model.remarks, f"{what}; the model's bias follows it ({trained}), and varies unseen")
        return _widened(out, *(model.tensors[f"temperature.{name}"] for name in ("spread", "walk")))
    name, channel = found
    out.log_drift = drift = TemperatureDrift(model, channel, name)
    out.remarks = (*model.remarks, *_remarks(channel, name, start_ns, end_ns, low, high))
    spread, walk = drift.beyond(start_ns, end_ns)
    return _widened(out, spread, walk) if spread.any() else out


def started_at(model: BiasModel, numbers: Sequence[tuple[int, float]], start_ns: int, end_ns: int) -> BiasModel:
    """Model with its drift in the first samples of a stream, by stamps and temperatures."""
    t_ns, values = np.array([t for t, _ in numbers], np.int64), np.array([T for _, T in numbers], np.float64)
    known = {scale_of(model).channel: thinned(t_ns, values, "")} if numbers and model.temperature_parameters() else {}
    return bound(model, known, "", start_ns, end_ns)


def _remarks(channel: Scalars, name: str, start_ns: int, end_ns: int, low: float, high: float) -> Sequence[str]:
    """What makes the drift of a log less sure."""
    out, within = [], channel.between(start_ns, end_ns)
    T = within.values[:, 0] if len(within) else channel.values[:1, 0]
    if T.min() < low - MAX_BEYOND_K or T.max() > high + MAX_BEYOND_K:
        gone, trained = f"{T.min():.1f} to {T.max():.1f} °C", f"{low:.1f} to {high:.1f} °C"
        out.append(f"{name} goes from {gone}, and training had {trained}: beyond, the bias goes on straight and is less sure")
    age_s = float(np.diff(np.concatenate([[start_ns], within.t_ns, [end_ns]])).max()) * 1e-9
    if age_s > MAX_AGE_S:
        out.append(f"{name} is silent for {age_s:.0f} s: its last number holds")
    return out


def _widened(model: BiasModel, spread: Vector6, walk: Vector6) -> BiasModel:
    """Model whose rest bias varies as a drift that is not subtracted; changes the model."""

    def wider(std: Vector6) -> Vector6:
        return np.asarray(np.sqrt(np.asarray(std) ** 2 + spread**2))

    model.tensors = model.tensors | {
        "prior_std": wider(model.prior_std),
        "walk_std": np.sqrt(model.walk_std**2 + walk**2),
    }
    sessions = [{**session, "std": wider(session["std"]).tolist()} for session in model.card.get("sessions", [])]
    minimum = model.card.get("turn_on_least_std")
    model.card = {**model.card, "sessions": sessions, "turn_on_least_std": None if minimum is None else wider(minimum).tolist()}
    return model


def rows_without_drift(model: BiasModel, t_ns: Stamps, gyro: Vectors, accel: Vectors) -> tuple[Vectors, Vectors]:
    """Gyro and accel without the drift that a model follows in their log."""
    if model.log_drift is None:
        return gyro, accel
    drift = model.log_drift(t_ns)
    return gyro - drift[:, :3], accel - drift[:, 3:]


def without_drift(model: BiasModel, imu: Imu) -> Imu:
    """Samples without the drift that a model follows in their log."""
    gyro, accel = rows_without_drift(model, imu.t_ns, imu.gyro, imu.accel)
    return imu if model.log_drift is None else Imu(imu.t_ns, gyro, accel)


def with_drift(model: BiasModel, t_ns: Stamps, bias: Rows6, covariance: Covariances) -> tuple[Rows6, Covariances]:
    """Bias and covariance of samples without the drift, with that of the drift added."""
    if model.log_drift is None:
        return bias, covariance
    return bias + model.log_drift(t_ns), covariance + model.log_drift.covariance(t_ns)
