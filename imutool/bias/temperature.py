"""Bias that follows a log's temperature: d = K (x - mean of training).

x holds Legendre polynomials P of the temperature up to the third order, at once and behind lags, for the die lags what
measures the case: dz/dt = (P(s) - z) / tau, s = (T - centre) / half range of training. Polynomials of the third order are what
PX4 calibrates gyro and accelerometer with (PX4 user guide, thermal calibration); as there, s is clamped to the trained range.
Relative to the mean of training the drift is no part of the prior of the rest bias, and zero is the best guess without a
temperature.

The drift depends on the time alone: samples are corrected for it first, and a model then works on these as without it. A number
of the channel holds until the next one, so that no sample depends on a later number.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.bias.model import COLUMNS, BiasModel, Covariances, Vector6
from imutool.errors import ModelError
from imutool.mcap_io.temperature import is_temperature, thinned
from imutool.recording import Imu, Recording, Scalars
from imutool.sensor import catalogue
from imutool.sensor.effect import Effect, Parameter, Stage, Theta
from imutool.sensor.linear_form import LinearForm
from imutool.sensor.samples import SensorSamples
from imutool.sensor.signals import LOAD_TAU_S, TEMPERATURE_TERMS
from imutool.units import AXES, SENSORS, Sensor

ORDERS = 3
ZERO_CELSIUS_K = 273.15
LEAST_KELVIN = 200.0  # no sensor works at as many °C, none at fewer kelvin
MOST_AGE_S = 60.0  # of a number of the channel: a case warms within minutes
MOST_BEYOND_K = 1.0  # beyond the trained range, before it counts as another one
PLAUSIBLE: Mapping[Sensor, tuple[str, float]] = {"gyro": ("rad/s", 0.01), "accel": ("m/s²", 0.1)}
Terms = Float64[np.ndarray, "n 12"]
Rows3 = Float64[np.ndarray, "n 3"]
Drift = Float64[np.ndarray, "n 6"] | None


def _form(sensor: Sensor) -> LinearForm:
    """Linear form of the drift of one sensor; its terms are the signals' `temperature`."""

    def forward(samples: SensorSamples, theta: Theta) -> SensorSamples:
        known = None if samples.online is None else samples.online.temperature
        return samples if known is None else samples.with_added(sensor, known @ theta.reshape(3, TEMPERATURE_TERMS).T)

    unit, plausible = PLAUSIBLE[sensor]
    lags = ("", *(f"{tau_s:g}s_" for tau_s in LOAD_TAU_S))
    names = [f"{axis}_{lag}p{order}" for axis in AXES for lag in lags for order in range(1, ORDERS + 1)]
    parameters = tuple(Parameter(name, unit, plausible) for name in names)
    equation = f"{sensor} += K (x - mean), x = P(T) at once and behind dz/dt = (P(T) - z) / tau"
    effect = Effect(
        f"{sensor}_temperature",
        Stage.SENSOR,
        (sensor,),
        equation,
        parameters,
        "the log's temperature varies",
        forward,
        trained=True,
        diagnosed=False,
        basis=lambda signals: (
            np.zeros((len(signals.t_s), TEMPERATURE_TERMS)) if signals.temperature is None else signals.temperature
        ),
    )
    pattern = np.zeros((3, TEMPERATURE_TERMS, 3 * TEMPERATURE_TERMS))
    for axis, term in np.ndindex(3, TEMPERATURE_TERMS):
        pattern[axis, term, axis * TEMPERATURE_TERMS + term] = 1.0
    size = len(parameters)
    return LinearForm(effect, sensor, parameters, np.zeros(size), np.arange(size), None, (), pattern)


FORMS: Mapping[Sensor, LinearForm] = {sensor: _form(sensor) for sensor in SENSORS}
EFFECTS = tuple(form.name for form in FORMS.values())


def forms(sensor: Sensor, names: Sequence[str]) -> tuple[LinearForm, ...]:
    """Linear forms of some effects on a sensor, a drift with the temperature among them.

    Raises:
        ConfigError: as `catalogue.trained`.
    """
    own = FORMS[sensor]
    others = iter(catalogue.trained(sensor, [name for name in names if name != own.name]))
    return tuple(own if name == own.name else next(others) for name in names)


def columns_of(effects: Sequence[LinearForm], *, temperature: bool) -> Int64[np.ndarray, " p"]:
    """Parameters of the drift with the temperature, or those of the other effects."""
    wanted = [(effect.name in EFFECTS) == temperature for effect in effects for _ in effect.parameters]
    return np.flatnonzero(wanted)


def samples_alone(effects: Sequence[LinearForm]) -> tuple[LinearForm, ...]:
    """Effects that follow from the samples alone."""
    return tuple(effect for effect in effects if effect.name not in EFFECTS)


class TemperatureFilter:
    """Terms x of a temperature channel, number by number; the states begin settled at the first."""

    def __init__(self, centre: float, half_range: float) -> None:
        self._centre, self._half_range = centre, half_range
        self._t_ns = 0
        self._z: Float64[np.ndarray, "4 3"] | None = None

    def __call__(self, t_ns: int, celsius: float) -> Float64[np.ndarray, "12"]:
        """Terms from this number on."""
        s = min(1.0, max(-1.0, (celsius - self._centre) / self._half_range))
        now = np.array([s, 1.5 * s**2 - 0.5, 2.5 * s**3 - 1.5 * s])
        if self._z is None:
            self._z = np.tile(now, (1 + len(LOAD_TAU_S), 1))
        else:
            keep = np.exp(-1e-9 * (t_ns - self._t_ns) / LOAD_TAU_S)[:, None]
            self._z[1:] = self._z[0] + keep * (self._z[1:] - self._z[0])
            self._z[0] = now
        self._t_ns = t_ns
        return self._z.ravel().copy()


class Scale(NamedTuple):
    """Channel, range and mean terms of the training logs' temperature."""

    channel: str
    centre: float  # °C
    half_range: float  # K
    mean: Float64[np.ndarray, "12"]

    def terms(self, channel: Scalars) -> Terms:
        """Terms at each number of a channel in °C, minus their mean."""
        follow = TemperatureFilter(self.centre, self.half_range)
        rows = [follow(t_ns, T) for t_ns, T in zip(channel.t_ns.tolist(), channel.values[:, 0].tolist(), strict=True)]
        return np.asarray(np.array(rows).reshape(-1, TEMPERATURE_TERMS) - self.mean)


def holding(channel_ns: Int64[np.ndarray, " m"], t_ns: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
    """Row of a channel that holds at each time; before the first, the first."""
    return np.maximum(np.searchsorted(channel_ns, t_ns, side="right") - 1, 0)


class TemperatureDrift:
    """Drift of a model's bias in one log, by its stamps."""

    def __init__(self, model: BiasModel, channel: Scalars, name: str) -> None:
        self.name, self._t_ns = name, channel.t_ns
        self._terms = scale_of(model).terms(channel)
        self._by_sensor = model.temperature_parameters()
        self._bias = np.zeros((len(self._terms), 6))
        for sensor, (theta, _) in self._by_sensor.items():
            self._bias[:, COLUMNS[sensor]] = self._terms @ theta.reshape(3, TEMPERATURE_TERMS).T

    def __call__(self, t_ns: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, "n 6"]:
        """Drift at some stamps: gyro (rad/s), then accel (m/s²)."""
        return np.asarray(self._bias[holding(self._t_ns, t_ns)])

    def covariance(self, t_ns: Int64[np.ndarray, " n"]) -> Covariances:
        """Covariance of the drift relative to its mean so far.

        The mean acts like a rest bias, and counts in its covariance (`imutool.bias_start.bias_covariance`).
        """
        out, rows = np.zeros((len(t_ns), 6, 6)), holding(self._t_ns, t_ns)
        if not len(rows):
            return out
        row, place = np.unique(rows, return_inverse=True)
        means = np.cumsum(self._terms[: row[-1] + 1], axis=0)[row] / (row + 1.0)[:, None]
        off = self._terms[row] - means
        for sensor, (_, covariance) in self._by_sensor.items():
            blocks = covariance.reshape(3, TEMPERATURE_TERMS, 3, TEMPERATURE_TERMS)
            S = np.einsum("nq,iqjr,nr->nij", off, blocks, off, optimize=True)
            out[:, COLUMNS[sensor], COLUMNS[sensor]] = S[place]
        return out


def scale_of(model: BiasModel) -> Scale:
    """Channel, range and mean terms that a model was trained with.

    Raises:
        ModelError: the model file has none.
    """
    if "temperature.units" not in model.tensors:
        raise ModelError("a drift with the temperature without its range", where=str(model.card.get("name", model.method)))
    centre, units, mean = (model.tensors[f"temperature.{name}"] for name in ("centre", "units", "mean"))
    return Scale(str(getattr(model.config, "temperature", "")), float(centre[0]), float(units[0]), mean)


def channel_of(scalars: Mapping[str, Scalars], imu_topic: str, wanted: str = "") -> tuple[str, Scalars] | None:
    """Channel of an IMU's temperature by name, in °C; None if none is its own.

    It is the one wanted, else the nearest by name: a channel under the IMU's own topic, then one that names an IMU or a gyro,
    then the only one.
    """
    numbers = {name: given for name, given in scalars.items() if is_temperature(name) and given.values.shape[1] == 1}
    found = {name: celsius for name, given in numbers.items() if len(celsius := _celsius(given)) > 1}
    if wanted in found:
        return wanted, found[wanted]
    ranks: dict[int, list[str]] = {}
    for name in found:
        own = name.startswith(f"{imu_topic}/") or name.startswith(f"{imu_topic}.")
        ranks.setdefault(2 if own else 1 if any(word in name.lower() for word in ("imu", "gyro")) else 0, []).append(name)
    best = ranks[max(ranks)] if ranks else []
    return (best[0], found[best[0]]) if len(best) == 1 else None


def _celsius(channel: Scalars) -> Scalars:
    """A channel's numbers in °C, two a second at most; those of another shape are none."""
    kept = thinned(
        channel.t_ns, channel.values[:, 0] if channel.values.shape[1] == 1 else channel.values[:, 0] * np.nan, "degC"
    )
    kelvin = channel.unit.lower() in ("k", "kelvin") or (len(kept) and float(np.median(kept.values)) > LEAST_KELVIN)
    return Scalars(kept.t_ns, kept.values - ZERO_CELSIUS_K, "degC") if kelvin else kept


def bound(model: BiasModel, scalars: Mapping[str, Scalars], imu_topic: str, start_ns: int, end_ns: int) -> BiasModel:
    """Model with its drift in one log; the model itself where it follows no temperature.

    Without a channel there is no drift, and the rest bias varies as much as the drift did in training. `remarks` say so, and
    what else makes the drift less sure.
    """
    if not model.temperature_parameters():
        return model
    scale, out = scale_of(model), copy.copy(model)
    low, high = scale.centre - scale.half_range, scale.centre + scale.half_range
    trained = f"{scale.channel}, {low:.1f} to {high:.1f} °C in training"
    found = channel_of(scalars, imu_topic, scale.channel)
    if found is None:
        several = [name for name in scalars if is_temperature(name)]
        what = f"names no temperature as the IMU's among {', '.join(several)}" if several else "has no temperature"
        out.remarks = (f"the log {what}; the model's bias follows it ({trained}), and varies unseen",)
        return _widened(out)
    name, channel = found
    out.log_drift = TemperatureDrift(model, channel, name)
    out.remarks = tuple(_remarks(channel, name, start_ns, end_ns, low, high, trained))
    return out


def _remarks(channel: Scalars, name: str, start_ns: int, end_ns: int, low: float, high: float, trained: str) -> Sequence[str]:
    """What makes the drift of a log less sure."""
    out, within = [], channel.between(start_ns, end_ns)
    T = within.values[:, 0] if len(within) else channel.values[:1, 0]
    if T.min() < low - MOST_BEYOND_K or T.max() > high + MOST_BEYOND_K:
        out.append(f"{name} goes from {T.min():.1f} to {T.max():.1f} °C, beyond the model's range ({trained}): it is clamped")
    edges = np.concatenate([[start_ns], within.t_ns, [end_ns]])
    age_s = float(np.diff(edges).max()) * 1e-9
    if age_s > MOST_AGE_S:
        out.append(f"{name} is silent for {age_s:.0f} s: its last number holds")
    return out


def _widened(model: BiasModel) -> BiasModel:
    """Model whose rest bias varies as the drift did in training; a copy."""
    spread, walk = (model.tensors[f"temperature.{name}"] for name in ("spread", "walk"))

    def wider(std: Vector6) -> Vector6:
        return np.sqrt(np.asarray(std) ** 2 + spread**2)

    model.tensors = model.tensors | {
        "prior_std": wider(model.prior_std),
        "walk_std": np.sqrt(model.walk_std**2 + walk**2),
    }
    sessions = [{**session, "std": wider(session["std"]).tolist()} for session in model.card.get("sessions", [])]
    least = model.card.get("turn_on_least_std")
    model.card = {**model.card, "sessions": sessions, "turn_on_least_std": None if least is None else wider(least).tolist()}
    return model


def bound_to(model: BiasModel, recording: Recording) -> BiasModel:
    """Model with its drift in a recording (`bound`)."""
    t_ns = recording.imu.t_ns
    return bound(model, recording.scalars, recording.imu_topic, int(t_ns[0]), int(t_ns[-1]))


def split_drift(model: BiasModel, t_ns: Int64[np.ndarray, " n"], gyro: Rows3, accel: Rows3) -> tuple[Drift, Rows3, Rows3]:
    """Drift that a model follows in its log, None for most models, and samples without it."""
    if model.log_drift is None:
        return None, gyro, accel
    drift = model.log_drift(t_ns)
    return drift, gyro - drift[:, :3], accel - drift[:, 3:]


def without_drift(model: BiasModel, imu: Imu) -> Imu:
    """Samples without the drift that a model follows in their log."""
    _, gyro, accel = split_drift(model, imu.t_ns, imu.gyro, imu.accel)
    return imu if model.log_drift is None else Imu(imu.t_ns, gyro, accel)
