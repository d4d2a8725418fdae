"""Training of `hybrid`: effects by least squares, then the ODE on corrected recordings.

Effects are chosen on the training part, and then fitted to the whole logs.

The ODE is trained as `neural_ode` is. The model keeps it if it takes at least `LEAST_GAIN` off the held-out error of either
sensor.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
import torch

from imutool.bias import neural_ode
from imutool.bias.hybrid import Config
from imutool.bias.networks import hybrid
from imutool.bias.networks import neural_ode as ode_network
from imutool.bias.networks.network import BiasNetwork
from imutool.config import build, plain
from imutool.errors import ConfigError
from imutool.recording import Imu, Recording, seconds
from imutool.sensor import catalogue, physics_file
from imutool.sensor.signals import SignalFilter, Signals
from imutool.training.calibration import Calibration, calibrate
from imutool.training.fit import Epoch
from imutool.training.segments import Pool
from imutool.training.settings import TrainSettings
from imutool.units import SENSORS, Sensor

LEAST_GAIN = 0.03  # of the held-out error, for an ODE to be worth its weights


@dataclass(frozen=True)
class PhysicsFirst:
    """Hybrid model with fitted effects, and the recordings corrected for them."""

    model: hybrid.Network
    found: dict[Sensor, Calibration]
    recordings: list[Recording]

    @classmethod
    def of(
        cls, recordings: Sequence[Recording], settings: TrainSettings, device: str, report: Callable[[Epoch], None]
    ) -> PhysicsFirst:
        """Fit the effects of the gyro, then of the accelerometer.

        Raises:
            DataError: no truth, too little of it, or different rates.
            ConfigError: unknown settings, or an effect that is not known.
        """
        pool = Pool.of(recordings, device=device)
        torch.manual_seed(settings.seed)
        model = hybrid.Network(config_of(settings), pool.rate_hz).double()
        signals, found = _online_signals(recordings, pool), {}
        gyro = pool.gyro
        for sensor in SENSORS:
            report(Epoch(sensor, 0, 0, math.nan, math.nan, math.nan, 0.0, f"looking for effects on the {sensor}"))
            chosen = calibrate(pool, sensor, gyro, model.config.effects(sensor), "train", signals)
            whole = calibrate(pool, sensor, gyro, chosen.effects, "all", signals)  # nothing is left to be chosen
            found[sensor] = replace(whole, gains=chosen.gains)
            model.take(sensor, found[sensor].effects, found[sensor].theta, found[sensor].covariance)
            if sensor == "gyro":
                error = torch.from_numpy(model.error("gyro", signals)).to(pool.gyro)
                gyro = pool.gyro - error - found[sensor].rest[pool.log]
        return cls(model, found, _without(model, recordings))

    def ode_settings(self, settings: TrainSettings) -> TrainSettings:
        """Settings of the ODE's own training."""
        ode: neural_ode.Config = self.model.config.ode
        return msgspec.structs.replace(settings, model=plain(ode))

    def finish(self, learnt: BiasNetwork) -> hybrid.Network:
        """Complete model with the trained ODE, or without one where a constant was enough."""
        model = self.model
        if isinstance(learnt, ode_network.Network):
            assert model.ode is not None
            model.ode.load_state_dict(learnt.state_dict())
        else:
            model.drop_remainder()
        for name, value in learnt.named_buffers(recurse=False):
            getattr(model, name).copy_(value)
        return model


def settings_for(physics: Path) -> tuple[list[str], tuple[str, ...]]:
    """Settings for `hybrid` with the effects of a physics.toml, and names that it cannot have.

    Their parameters are fitted anew to the logs. Effects that it cannot have, or without a name, are left to the neural ODE.

    Raises:
        ConfigError: the file cannot be read, or names no effect that `hybrid` can have.
    """
    names = tuple(dict.fromkeys(entry.name for entry in physics_file.read(physics).effect))
    by_sensor = {sensor: [form.name for form in catalogue.trained(sensor) if form.name in names] for sensor in SENSORS}
    taken = {name for some in by_sensor.values() for name in some}
    if not taken:
        raise ConfigError("no effect that a bias model can correct", where=physics, expected="for instance gyro_scale")
    words = [f"model.{sensor}_effects={json.dumps(some)}" for sensor, some in by_sensor.items()]
    return words, tuple(name for name in names if name not in taken)


def helps(before: dict[Sensor, float], after: dict[Sensor, float]) -> bool:
    """Whether a descent lowers one held-out error enough and does not raise the other."""
    gains = [1 - after[sensor] / before[sensor] for sensor in SENSORS]
    return max(gains) >= LEAST_GAIN and min(gains) > -LEAST_GAIN


def config_of(settings: TrainSettings) -> Config:
    """Model settings, their effects checked.

    Raises:
        ConfigError: an unknown setting or effect (the nearest is named), or an effect on the wrong sensor.
    """
    config = build(Config, settings.model, where="model settings of hybrid")
    catalogue.trained("gyro", config.gyro_effects or ())
    catalogue.trained("accel", config.accel_effects or ())
    return config


def _online_signals(recordings: Sequence[Recording], pool: Pool) -> Signals:
    """Signals of a pool's samples as online: filters and time start where the log does."""
    parts: list[Signals] = []
    for recording, count in zip(recordings, torch.bincount(pool.log).tolist(), strict=True):
        first = int(np.searchsorted(recording.imu.t_ns, recording.overlap().imu.t_ns[0]))
        parts.append(_signals(recording.imu, pool.rate_hz).rows(slice(first, first + count)))
    return Signals(np.concatenate([part.t_s for part in parts]), np.concatenate([part.columns for part in parts]))


def _signals(imu: Imu, rate_hz: float) -> Signals:
    return SignalFilter(rate_hz)(seconds(imu.t_ns, int(imu.t_ns[0])), imu.gyro, imu.accel)


def _without(model: hybrid.Network, recordings: Sequence[Recording]) -> list[Recording]:
    """Recordings corrected for the model's effects."""
    return [replace(recording, imu=_corrected(model, recording.imu)) for recording in recordings]


def _corrected(model: hybrid.Network, imu: Imu) -> Imu:
    signals = _signals(imu, model.rate_hz)
    return Imu(imu.t_ns, imu.gyro - model.error("gyro", signals), imu.accel - model.error("accel", signals))


def described(found: dict[Sensor, Calibration]) -> Iterator[tuple[str, dict[str, object]]]:
    """Entries of a model card: effects, gains on logs left out of the fit, unseen parameters."""
    for sensor, fitted in found.items():
        yield sensor, {"effects": list(fitted.effects), "gains": dict(fitted.gains), "unseen": list(fitted.unseen)}
