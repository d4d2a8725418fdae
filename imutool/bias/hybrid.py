"""Hybrid bias model: rest bias + fitted effects + a neural ODE on the corrected samples.

The effects are those of `imutool.sensor.effects` that the training logs support
(`imutool.training.calibration.effect_selection`). They are linear in their parameters, fitted together by least squares with
a covariance, chosen by how well logs predict one another.
The neural ODE (`imutool.bias.neural_ode`) sees samples corrected for the effects. It is left out where it does not help on the
held-out part: then debiasing is a few products a sample.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from functools import partial
from typing import ClassVar, Self

import msgspec
import numpy as np

from imutool.array_types import Float64, Int64, Vectors
from imutool.bias import neural_ode
from imutool.bias.effects_stream import EffectsStream
from imutool.bias.model import Array, BiasModel, CovarianceModel, Shapes, Stream, Vector6
from imutool.bias.temperature import columns_of, forms, samples_alone
from imutool.config import Settings
from imutool.sensor.linear_form import CompiledEffects, LinearForm, compiled, patterns
from imutool.sensor.signals import LOAD, SignalFilter, Signals
from imutool.units import SENSORS, Sensor


class Config(Settings, frozen=True):
    """Effects of each sensor by name (None: the training chooses), and the neural ODE.

    `temperature` is the log's channel that the drifts `gyro_temperature` and `accel_temperature` follow.
    """

    gyro_effects: tuple[str, ...] | None = None  # names of effects; without them the training chooses
    accel_effects: tuple[str, ...] | None = None  # the same for the accelerometer
    remainder: bool = True  # whether a neural ODE may learn what the effects leave
    ode: neural_ode.Config = neural_ode.Config()
    temperature: str | msgspec.UnsetType = msgspec.UNSET  # channel of the log that drifts with the temperature follow

    def effects(self, sensor: Sensor) -> tuple[str, ...] | None:
        """Effects that the settings name for a sensor; None if the training chooses."""
        return self.gyro_effects if sensor == "gyro" else self.accel_effects


class Model(BiasModel):
    """Bias b = rest + E_theta(signals) + C(u - E) + drift.

    Sources: the effects' files; Rehder et al., ICRA 2016, for the joint fit; `imutool.bias.neural_ode`.
    """

    method: ClassVar[str] = "hybrid"
    config: Config

    def __init__(
        self,
        config: Settings,
        rate_hz: float,
        tensors: Mapping[str, np.ndarray] | None = None,
        effects: Mapping[Sensor, tuple[LinearForm, ...]] | None = None,
    ) -> None:
        super().__init__(config, rate_hz, tensors)
        self.effects = effects or {sensor: forms(sensor, self.config.effects(sensor) or ()) for sensor in SENSORS}
        self.ode: neural_ode.Model | None = None
        if self.config.remainder:
            ode_tensors = {name.removeprefix("ode."): value for name, value in self.tensors.items() if name.startswith("ode.")}
            self.ode = neural_ode.Model(self.config.ode, rate_hz, ode_tensors)
            self.counts_samples = self.ode.counts_samples

    @classmethod
    def shapes(cls, config: Settings) -> Shapes:
        """Shapes of the statistics, of the effects' parameters with their covariance, and of the neural ODE.

        Raises:
            ConfigError: an unknown effect, or an effect that does not act on its sensor.
        """
        assert isinstance(config, Config)
        shapes = super().shapes(config)
        for sensor in SENSORS:
            effects = forms(sensor, config.effects(sensor) or ())
            size = sum(len(effect.parameters) for effect in effects)
            shapes |= {f"theta_{sensor}": (size,), f"covariance_{sensor}": (size, size)}
        ode = neural_ode.Model.shapes(config.ode) if config.remainder else {}
        return shapes | {f"ode.{name}": shape for name, shape in ode.items()}

    def at(self, rate_hz: float) -> Self:
        """Model for samples at another rate."""
        out = super().at(rate_hz)
        out.ode = None if self.ode is None else self.ode.at(rate_hz)
        return out

    def error(self, sensor: Sensor, signals: Signals) -> Vectors:
        """Error of the effects at some signals (rad/s or m/s²)."""
        return self._compiled(sensor)(signals)

    def stretch(self, rest: Vector6, start_s: float = math.nan) -> Stream:
        """Bias stream, with filters that start at its first sample."""
        ode = None if self.ode is None else self.ode.stretch(rest)
        gyro, accel = (self._compiled(sensor) for sensor in SENSORS)
        return EffectsStream(self.rate_hz, gyro, accel, ode, rest.astype(np.float64), start_s, self.load_before)

    def rest_dynamics(self) -> Float64[np.ndarray, "6 6"]:
        """Rest dynamics of the neural ODE."""
        return np.zeros((6, 6)) if self.ode is None else self.ode.rest_dynamics()

    def follows_load(self) -> bool:
        """Whether an effect is a drift behind the load."""
        return any(self._compiled(sensor).wanted > LOAD.start for sensor in SENSORS)

    def temperature_parameters(self) -> Mapping[Sensor, tuple[Array, Array]]:
        """Parameters of the drifts with a log's temperature, by sensor."""
        found: dict[Sensor, tuple[Array, Array]] = {}
        for sensor in SENSORS:
            own = columns_of(self.effects[sensor], temperature=True)
            if len(own):
                found[sensor] = self.tensors[f"theta_{sensor}"][own], self.tensors[f"covariance_{sensor}"][np.ix_(own, own)]
        return found

    def calibration_covariance(self) -> CovarianceModel | None:
        """Root T Sigma^1/2 of the covariance of the effects' error, T Sigma T^T."""
        roots: dict[Sensor, Float64[np.ndarray, "3 q p"]] = {}
        of_samples = {sensor: self._of_samples(sensor) for sensor in SENSORS}
        for sensor, (effects, own) in of_samples.items():
            values, vectors = np.linalg.eigh(self.tensors[f"covariance_{sensor}"][np.ix_(own, own)])
            root = vectors * np.sqrt(np.maximum(values, 0.0))
            roots[sensor] = patterns(effects) @ root
        filter_ = SignalFilter(self.rate_hz, max(self._compiled(sensor).wanted for sensor in SENSORS), self.load_before)
        return partial(_roots_at, filter_, {sensor: effects for sensor, (effects, _) in of_samples.items()}, roots)

    def _compiled(self, sensor: Sensor) -> CompiledEffects:
        effects, own = self._of_samples(sensor)
        return compiled(effects, self.tensors[f"theta_{sensor}"][own])

    def _of_samples(self, sensor: Sensor) -> tuple[tuple[LinearForm, ...], Int64[np.ndarray, " p"]]:
        """Effects that follow from the samples, and where their parameters stand."""
        effects = self.effects[sensor]
        return samples_alone(effects), columns_of(effects, temperature=False)


def without_lever_arm(model: BiasModel) -> BiasModel:
    """Model without its lever arm to the poses' point, which is no error of the sensor."""
    if not isinstance(model, Model):
        return model
    out, arms = copy.copy(model), [form.name == "lever_arm" for form in model.effects["accel"] for _ in form.parameters]
    out.tensors = {**model.tensors, "theta_accel": np.where(arms, 0.0, model.tensors["theta_accel"])}
    return out


def _roots_at(
    filter_: SignalFilter,
    effects: Mapping[Sensor, tuple[LinearForm, ...]],
    roots: Mapping[Sensor, Float64[np.ndarray, "3 q p"]],
    t_s: Float64[np.ndarray, " n"],
    gyro: Vectors,
    accel: Vectors,
) -> dict[Sensor, Float64[np.ndarray, "n 3 p"]]:
    """Roots at each sample; a closure's filter would be shared by a copy."""
    signals, out = filter_(t_s, gyro, accel), {}
    for sensor, forms_of in effects.items():
        if forms_of:
            terms = np.concatenate([effect.terms(signals) for effect in forms_of], axis=1)
            out[sensor] = np.einsum("nq,iqp->nip", terms, roots[sensor], optimize=True)
    return out
