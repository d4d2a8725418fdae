"""Hybrid bias model: rest bias + fitted effects + a neural ODE on the corrected samples.

The effects are those of `imutool.sensor.effects` that the training logs support (`imutool.training.calibration`): linear in
their parameters, fitted together by least squares with a covariance, chosen by how well logs predict one another. The neural
ODE (`imutool.bias.neural_ode`) sees samples corrected for the effects. It is left out where it does not help on the held-out
part: then debiasing is a few products a sample.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import msgspec
import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from imutool.bias import neural_ode
from imutool.bias.model import COLUMNS, BiasModel, CovarianceModel, SampleStream, Segment, Stream, Vector6
from imutool.config import Settings
from imutool.errors import ConfigError
from imutool.sensor import catalogue
from imutool.sensor.linear_form import CompiledEffects, LinearForm, compiled, patterns
from imutool.sensor.signals import POWER_S, SignalFilter, Signals
from imutool.units import SENSORS, Sensor

SETTLING = 10.0  # time constants after which the start of a filter no longer matters


class Config(Settings, frozen=True):
    """Effects of each sensor by name (None: the training chooses), and the neural ODE."""

    gyro_effects: tuple[str, ...] | None = None
    accel_effects: tuple[str, ...] | None = None
    remainder: bool = True
    ode: neural_ode.Config = neural_ode.Config()


class Model(BiasModel):
    """Bias b = rest + E_theta(signals) + C(u - E) + drift.

    Sources: the effects' files; Rehder et al., ICRA 2016, for the joint fit; `imutool.bias.neural_ode`.

    Raises:
        ConfigError: an unknown effect, or an effect that does not act on its sensor.
    """

    method: ClassVar[str] = "hybrid"
    config: Config

    def __init__(self, config: Settings | None = None, rate_hz: float = 200.0) -> None:
        chosen = config or Config()
        assert isinstance(chosen, Config)
        super().__init__(chosen, rate_hz)
        self.effects: dict[Sensor, tuple[LinearForm, ...]] = {"gyro": (), "accel": ()}
        for sensor in SENSORS:
            self._set_effects(sensor, self.named(sensor) or ())
        self.ode = neural_ode.Model(chosen.ode, rate_hz) if chosen.remainder else None

    def named(self, sensor: Sensor) -> tuple[str, ...] | None:
        """Effects that the settings name for a sensor; None if the training chooses."""
        return self.config.gyro_effects if sensor == "gyro" else self.config.accel_effects

    def take(self, sensor: Sensor, names: Sequence[str], theta: Float[Tensor, " p"], covariance: Float[Tensor, "p p"]) -> None:
        """Take over effects and their fitted parameters, in the order of `names`."""
        key = f"{sensor}_effects"
        self.config = msgspec.structs.replace(self.config, **{key: tuple(names)})
        self._set_effects(sensor, tuple(names))
        with torch.no_grad():
            getattr(self, f"theta_{sensor}").copy_(theta)
            getattr(self, f"covariance_{sensor}").copy_(covariance)

    def drop_remainder(self) -> None:
        """Drop the neural ODE and keep only the effects."""
        self.config, self.ode = msgspec.structs.replace(self.config, remainder=False), None

    def begin_at(self, sensor: Sensor, W: Float[Tensor, "3 3"]) -> None:
        """Refuse a start from a matrix, because all effects are fitted together.

        Raises:
            ConfigError: always; `imutool.training.run.train` knows how a hybrid is trained.
        """
        raise ConfigError(
            "hybrid does not start from a matrix",
            where="training hybrid",
            fix="Train it with imutool.training.run.train, or its parts with imutool.training.calibration",
        )

    def error(self, sensor: Sensor, signals: Signals) -> Float64[np.ndarray, "n 3"]:
        """Error of the effects at some signals (rad/s or m/s²)."""
        return self._compiled(sensor)(signals)

    def sensor_bias(self, sensor: Sensor, segment: Segment) -> Float[Tensor, "batch n 3"]:
        """Bias of the effects plus the neural ODE; filters start at the first sample."""
        error = self._on(sensor, segment)
        if self.ode is None:
            return segment.rest[:, None, COLUMNS[sensor]] + error
        corrected = {"gyro": segment.gyro, "accel": segment.accel}
        corrected[sensor] = corrected[sensor] - error
        return error + self.ode.sensor_bias(sensor, Segment(segment.t, corrected["gyro"], corrected["accel"], segment.rest))

    def stream(self, rest: Vector6) -> Stream:
        """Bias stream in numpy, from the log's first sample on."""
        ode = None if self.ode is None else self.ode.stream(rest)
        gyro, accel = (self._compiled(sensor) for sensor in SENSORS)
        return _Stream(self.rate_hz, gyro, accel, ode, rest.astype(np.float64))

    def rest_dynamics(self) -> Float64[np.ndarray, "6 6"]:
        """Rest dynamics of the neural ODE."""
        return np.zeros((6, 6)) if self.ode is None else self.ode.rest_dynamics()

    def calibration_covariance(self) -> CovarianceModel | None:
        """Root T Sigma^1/2 of the covariance of the effects' error, T Sigma T^T."""
        roots: dict[Sensor, Float64[np.ndarray, "3 q p"]] = {}
        for sensor in SENSORS:
            covariance: Tensor = getattr(self, f"covariance_{sensor}")
            values, vectors = np.linalg.eigh(covariance.detach().cpu().double().numpy())
            root = vectors * np.sqrt(np.maximum(values, 0.0))
            roots[sensor] = patterns(self.effects[sensor]) @ root
        filter_ = SignalFilter(self.rate_hz)

        def root_at(
            t_s: Float64[np.ndarray, " n"], gyro: Float64[np.ndarray, "n 3"], accel: Float64[np.ndarray, "n 3"]
        ) -> dict[Sensor, Float64[np.ndarray, "n 3 p"]]:
            signals, out = filter_(t_s, gyro, accel), {}
            for sensor in SENSORS:
                if self.effects[sensor]:
                    terms = np.concatenate([effect.terms(signals) for effect in self.effects[sensor]], axis=1)
                    out[sensor] = np.einsum("nq,iqp->nip", terms, roots[sensor], optimize=True)
            return out

        return root_at

    def _on(self, sensor: Sensor, segment: Segment) -> Float[Tensor, "batch n 3"]:
        rows = []
        for t, gyro, accel in zip(segment.t, segment.gyro, segment.accel, strict=True):
            arrays = (x.detach().cpu().double().numpy() for x in (t - t[0], gyro, accel))
            rows.append(torch.from_numpy(self.error(sensor, SignalFilter(self.rate_hz)(*arrays))))
        return torch.stack(rows).to(segment.t)

    def _set_effects(self, sensor: Sensor, names: tuple[str, ...]) -> None:
        self.effects[sensor] = catalogue.trained(sensor, names)
        size = sum(len(effect.parameters) for effect in self.effects[sensor])
        like = self.prior_mean
        self.register_buffer(f"theta_{sensor}", like.new_zeros(size))
        self.register_buffer(f"covariance_{sensor}", like.new_zeros(size, size))
        looks_back = any(self.effects.values())
        self.context = math.ceil(SETTLING * POWER_S * self.rate_hz) if looks_back else 0

    def _compiled(self, sensor: Sensor) -> CompiledEffects:
        theta: Tensor = getattr(self, f"theta_{sensor}")
        return compiled(self.effects[sensor], theta.detach().cpu().double().numpy())


class _Stream:
    """Bias stream: effects, then the neural ODE on the corrected samples."""

    def __init__(
        self, rate_hz: float, gyro: CompiledEffects, accel: CompiledEffects, ode: SampleStream | None, rest: Vector6
    ) -> None:
        self._signals = SignalFilter(rate_hz, max(gyro.wanted, accel.wanted))
        self._matrix = np.concatenate([gyro.matrix, accel.matrix], axis=1)
        self._gyro, self._accel, self._only_product = gyro, accel, not (gyro.others or accel.others)
        self._ode, self._rest, self._start_s = ode, rest, math.nan

    def __call__(
        self, t_s: Float64[np.ndarray, " n"], gyro: Float64[np.ndarray, "n 3"], accel: Float64[np.ndarray, "n 3"]
    ) -> Float64[np.ndarray, "n 6"]:
        if len(t_s) == 1:
            return self.one(float(t_s[0]), np.concatenate([gyro[0], accel[0]]))[None]
        if not len(t_s):
            return np.zeros((0, 6))
        if math.isnan(self._start_s):
            self._start_s = float(t_s[0])
        signals = self._signals(t_s - self._start_s, gyro, accel)
        error: Float64[np.ndarray, "n 6"] = np.dot(signals.columns, self._matrix)
        for columns, effects in ((COLUMNS["gyro"], self._gyro), (COLUMNS["accel"], self._accel)):
            for other in effects.others:
                error[:, columns] += other(signals)
        error += self._rest if self._ode is None else self._ode(t_s, gyro - error[:, :3], accel - error[:, 3:])
        return error

    def one(self, t_s: float, u: Vector6) -> Vector6:
        """Bias at one sample."""
        if math.isnan(self._start_s):
            self._start_s = t_s
        since_s = t_s - self._start_s
        row = self._signals.one(since_s, u)
        error: Vector6 = row.dot(self._matrix)
        if not self._only_product:
            floats = row.tolist()
            error += (*self._gyro.others_at(since_s, floats), *self._accel.others_at(since_s, floats))
        error += self._rest if self._ode is None else self._ode.one(t_s, u - error)
        return error
