"""Hybrid network: effects fitted in closed form, then a neural ODE (`imutool.bias.hybrid`)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

import msgspec
import numpy as np
import torch
from torch import Tensor

from imutool.array_types import Float, Float64, Vectors
from imutool.bias.hybrid import Config, Model
from imutool.bias.networks import neural_ode
from imutool.bias.networks.network import BiasNetwork, Segment
from imutool.bias.temperature import columns_of, forms, samples_alone
from imutool.config import Settings
from imutool.errors import ConfigError
from imutool.sensor.linear_form import LinearForm, compiled
from imutool.sensor.signals import POWER_S, SignalFilter, Signals
from imutool.units import SENSORS, Sensor

SETTLING = 10.0  # time constants after which the start of a filter no longer matters


class Network(BiasNetwork):
    """Network of `imutool.bias.hybrid`.

    Raises:
        ConfigError: an unknown effect, or an effect that does not act on its sensor.
    """

    method: ClassVar[str] = Model.method
    config: Config

    def __init__(self, config: Settings | None = None, rate_hz: float = 200.0) -> None:
        chosen = config or Config()
        assert isinstance(chosen, Config)
        super().__init__(chosen, rate_hz)
        self.effects: dict[Sensor, tuple[LinearForm, ...]] = {"gyro": (), "accel": ()}
        for sensor in SENSORS:
            self._set_effects(sensor, chosen.effects(sensor) or ())
        self.ode = neural_ode.Network(chosen.ode, rate_hz) if chosen.remainder else None

    def take(self, sensor: Sensor, names: Sequence[str], theta: Float[Tensor, " p"], covariance: Float[Tensor, "p p"]) -> None:
        """Take over effects and their fitted parameters, in the order of `names`."""
        self.config = msgspec.structs.replace(self.config, **{f"{sensor}_effects": tuple(names)})
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
            fix="Train it with imutool.training.run.train, or its parts with imutool.training.calibration.effect_selection",
        )

    def error(self, sensor: Sensor, signals: Signals) -> Vectors:
        """Error of the effects at some signals (rad/s or m/s²)."""
        theta: Tensor = getattr(self, f"theta_{sensor}")
        return compiled(self.effects[sensor], theta.detach().cpu().double().numpy())(signals)

    def temperature_theta(self) -> dict[Sensor, Float64[np.ndarray, " p"]]:
        """Parameters of the drifts with a log's temperature, by sensor."""
        own = {sensor: columns_of(effects, temperature=True) for sensor, effects in self.effects.items()}
        return {sensor: getattr(self, f"theta_{sensor}").cpu().double().numpy()[at] for sensor, at in own.items() if len(at)}

    def motion_bias(self, sensor: Sensor, segment: Segment) -> Float[Tensor, "batch n 3"]:
        """Error of the effects plus the curve of the neural ODE; filters start at the first sample."""
        error = self._on(sensor, segment)
        return error if self.ode is None else error + self.ode.motion_bias(sensor, _less(segment, sensor, error))

    def rest_bias(self, sensor: Sensor, segment: Segment) -> Float[Tensor, "batch n 3"]:
        """Rest bias, drifting as the neural ODE says of the corrected samples."""
        if self.ode is None or sensor not in self.config.ode.drift:
            return super().rest_bias(sensor, segment)
        return self.ode.rest_bias(sensor, _less(segment, sensor, self._on(sensor, segment)))

    def _on(self, sensor: Sensor, segment: Segment) -> Float[Tensor, "batch n 3"]:
        rows = []
        for t, gyro, accel in zip(segment.t, segment.gyro, segment.accel, strict=True):
            arrays = (x.detach().cpu().double().numpy() for x in (t - t[0], gyro, accel))
            rows.append(torch.from_numpy(self.error(sensor, SignalFilter(self.rate_hz)(*arrays))))
        return torch.stack(rows).to(segment.t)

    def _set_effects(self, sensor: Sensor, names: tuple[str, ...]) -> None:
        self.effects[sensor] = forms(sensor, names)
        size = sum(len(effect.parameters) for effect in self.effects[sensor])
        like = self.prior_mean
        self.register_buffer(f"theta_{sensor}", like.new_zeros(size))
        self.register_buffer(f"covariance_{sensor}", like.new_zeros(size, size))
        looks_back = any(samples_alone(effects) for effects in self.effects.values())
        self.context = math.ceil(SETTLING * POWER_S * self.rate_hz) if looks_back else 0


def _less(segment: Segment, sensor: Sensor, error: Float[Tensor, "batch n 3"]) -> Segment:
    """Segment with an error taken off one sensor's samples."""
    corrected = segment.of(sensor)[0] - error
    return replace(segment, gyro=corrected) if sensor == "gyro" else replace(segment, accel=corrected)
