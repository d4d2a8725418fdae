"""Bias that follows a log's temperature: d = K (x - mean of training).

x holds Legendre polynomials P of the temperature up to the third order, at once and behind lags, for the die lags what
measures the case: dz/dt = (P(s) - z) / tau, s = (T - centre) / half range of training. Polynomials of the third order are what
PX4 calibrates gyro and accelerometer with (PX4 user guide, thermal calibration). There s is clamped to the trained range; here
P goes on straight beyond it. Relative to the mean of training the drift is no part of the prior of the rest bias, and zero is
the best guess without a temperature.

The drift depends on the time alone: samples are corrected for it first, and a model then works on these as without it. A number
of the channel holds until the next one, so that no sample depends on a later number.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from imutool.array_types import Float64, Int64, Vectors
from imutool.bias.model import BiasModel
from imutool.errors import ModelError
from imutool.mcap_io.temperature import is_temperature, thinned
from imutool.recording import Scalars
from imutool.sensor import catalogue
from imutool.sensor.effect import Effect, Parameter, Stage, Theta
from imutool.sensor.linear_form import LinearForm
from imutool.sensor.samples import SensorSamples
from imutool.sensor.signals import LOAD_TAU_S, TEMPERATURE_TERMS
from imutool.units import AXES, SENSORS, Sensor

ORDERS = 3
ZERO_CELSIUS_K = 273.15
MAX_BEYOND = 5.0  # half ranges, beyond the trained one, for which the bias goes on: a channel may have a wrong number
MIN_KELVIN = 200.0  # no sensor works at as many °C, none at fewer kelvin
PLAUSIBLE: Mapping[Sensor, tuple[str, float]] = {"gyro": ("rad/s", 0.01), "accel": ("m/s²", 0.1)}
Terms = Float64[np.ndarray, "n 12"]


def _form(sensor: Sensor) -> LinearForm:
    """Linear form of the drift of one sensor; its terms are the signals' `temperature`."""

    def forward(samples: SensorSamples, theta: Theta) -> SensorSamples:
        known = None if samples.online is None else samples.online.temperature
        return samples if known is None else samples.with_added(sensor, known @ theta.reshape(3, TEMPERATURE_TERMS).T)

    unit, plausible = PLAUSIBLE[sensor]
    lags = ("", *(f"{tau_s:g}s_" for tau_s in LOAD_TAU_S))
    names = [f"{axis}_{lag}p{order}" for axis in AXES for lag in lags for order in range(1, ORDERS + 1)]
    parameters = tuple(Parameter(name, unit, plausible) for name in names)
    effect = Effect(
        f"{sensor}_temperature",
        Stage.SENSOR,
        (sensor,),
        f"{sensor} += K (x - mean), x = P(T) at once and behind dz/dt = (P(T) - z) / tau",
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
    return LinearForm(effect, sensor, parameters, np.zeros(size), np.arange(size), None, (), pattern, (_form, (sensor,)))


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
    return np.flatnonzero([(effect.name in EFFECTS) == temperature for effect in effects for _ in effect.parameters])


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
        at = (celsius - self._centre) / self._half_range
        s = min(1.0, max(-1.0, at))
        basis = np.array([s, 1.5 * s**2 - 0.5, 2.5 * s**3 - 1.5 * s]) + _straight_on(at)[0]
        if self._z is None:
            self._z = np.tile(basis, (1 + len(LOAD_TAU_S), 1))
        else:
            keep = np.exp(-1e-9 * max(0, t_ns - self._t_ns) / LOAD_TAU_S)[:, None]  # a clock may be set back
            self._z[1:] = self._z[0] + keep * (self._z[1:] - self._z[0])
            self._z[0] = basis
        self._t_ns = t_ns
        return self._z.ravel().copy()


def _straight_on(s: Float64[np.ndarray, " n"] | float) -> Vectors:
    """What Legendre polynomials gain beyond -1 to 1 by their slope at the end."""
    beyond = np.reshape(s - np.clip(s, -1.0, 1.0), (-1, 1)).clip(-MAX_BEYOND, MAX_BEYOND)
    return np.asarray(beyond * [1.0, 3.0, 6.0] * np.sign(beyond) ** [0, 1, 2])


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

    def beyond(self, channel: Scalars) -> Terms:
        """What the terms gain beyond the range, once all lags are over."""
        return np.tile(_straight_on((channel.values[:, 0] - self.centre) / self.half_range), 1 + len(LOAD_TAU_S))


def holding(channel_ns: Int64[np.ndarray, " m"], t_ns: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
    """Row of a channel that holds at each time; before the first, the first."""
    return np.maximum(np.searchsorted(channel_ns, t_ns, side="right") - 1, 0)


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
    found = {name: celsius for name, given in numbers.items() if len(celsius := _celsius(given))}
    if wanted in found:
        return wanted, found[wanted]
    ranks: dict[int, list[str]] = {}
    for name in found:
        own = name.startswith(f"{imu_topic}/") or name.startswith(f"{imu_topic}.")
        ranks.setdefault(2 if own else 1 if any(word in name.lower() for word in ("imu", "gyro")) else 0, []).append(name)
    best = ranks[max(ranks)] if ranks else []
    return (best[0], found[best[0]]) if len(best) == 1 else None


def _celsius(channel: Scalars) -> Scalars:
    """A channel's numbers in °C, two a second at most."""
    kept = thinned(channel.t_ns, channel.values[:, 0], "degC")
    if not len(kept):
        return kept
    usual = float(np.median(kept.values))
    off = ZERO_CELSIUS_K if channel.unit.lower() in ("k", "kelvin") else usual - celsius_of(usual)
    return Scalars(kept.t_ns, kept.values - off, "degC")


def celsius_of(temperature: float) -> float:
    """°C of a temperature in °C or kelvin, told by its size."""
    return temperature - ZERO_CELSIUS_K if temperature > MIN_KELVIN else temperature
