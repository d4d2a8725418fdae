"""How to train: the settings of a training, and the defaults that a method prefers."""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from imutool import registry
from imutool.array_types import Float64
from imutool.config import Settings
from imutool.errors import ConfigError
from imutool.sensor import catalogue, physics_file
from imutool.sensor.linear_form import LinearForm
from imutool.units import SENSORS, Sensor

Positive = Annotated[float, msgspec.Meta(gt=0)]
Count = Annotated[int, msgspec.Meta(ge=1)]
Lengths = Annotated[tuple[Positive, ...], msgspec.Meta(min_length=1)]
Counts = Annotated[tuple[Count, ...], msgspec.Meta(min_length=1)]
LINEAR: Mapping[Sensor, tuple[str, ...]] = {sensor: (f"{sensor}_misalignment", f"{sensor}_scale") for sensor in SENSORS}
MIN_RESIDUAL = 1e-6  # rad or m/s: no truth is better, and perfect data must not outweigh the prior beyond float64's digits


class IncrementSettings(Settings, frozen=True):
    """Lengths and stretches for methods that descend on increments.

    See `imutool.training.objectives.increments`.
    """

    gyro_samples: Counts = (16, 32)  # lengths of the increments of attitude
    accel_samples: Counts = (16, 32)  # the same of velocity
    stretch_s: Positive = 16.0  # whose increments all count in a step


class PaperSettings(Settings, frozen=True):
    """Training of the paper's scheme (`imutool.training.objectives.paper_scheme`).

    Numbers of the paper and of its released code.
    """

    samples: Count = 16  # of a segment
    segments: Count = 1000  # a step
    gyro_steps: Annotated[int, msgspec.Meta(ge=0)] = 1800  # of the gyro's training
    accel_steps: Annotated[int, msgspec.Meta(ge=0)] = 1800  # of the accelerometer's
    rate: Positive = 5e-3  # learning rate of Adam
    halve_every: Count = 300  # steps
    weight_decay: Annotated[float, msgspec.Meta(ge=0)] = 1e-6  # of AdamW
    smoothed_samples: Count = 1  # around a segment's first bias; the released code has 15 for TUM-VI


class PoseFloors(Settings, frozen=True):
    """Least residual of a window by the kind of its poses: of the order of what good ones reach.

    Poses made with this IMU follow its errors, so that a small residual is no sign of their quality. An estimate counts as one
    of a good GNSS/INS, of the order of 0.1 degrees and 0.014 m/s. Odometry counts as ten times worse. All four are choices.
    """

    estimate_rad: Positive = 1.7e-3  # of a window's attitude, where the poses are an estimate
    estimate_m_s: Positive = 0.014  # of its velocity
    odometry_rad: Positive = 1.7e-2  # the same, where they are odometry
    odometry_m_s: Positive = 0.14  # of its velocity, likewise

    def of(self, kind: str) -> tuple[float, float]:
        """Least residuals of gyro (rad) and accel (m/s); of a truth and of poses of unknown kind almost none."""
        known = {"estimate": (self.estimate_rad, self.estimate_m_s), "odometry": (self.odometry_rad, self.odometry_m_s)}
        return known.get(kind, (MIN_RESIDUAL, MIN_RESIDUAL))


class SensorPrior(Settings, frozen=True):
    """Prior over sensors: standard deviations of an effect's parameters, about zero.

    From data sheets: MPU-6050 (PS-MPU-6000A 3.4) for consumer sensors, ADIS16448 for industrial ones. What they were judged by
    is in docs/measurements/a-minute.md. Comments state units. An effect that is not named here has its plausible size.
    """

    gyro_scale: Positive = 0.05  # -: MPU-6050 ±3 %; a choice, wider because TUM-VI's BMI160 has 10 %
    gyro_misalignment: Positive = 0.02  # -: MPU-6050 ±2 % across axes, and a degree between poses and sensor
    gyro_g_sensitivity: Positive = 2e-4  # rad/s per m/s²: MPU-6050 0.1 °/s/g; ADIS16448 0.015 °/s/g
    gyro_quadratic: Positive = 1e-3  # s/rad: MPU-6050 0.2 % of a full scale of 250 °/s
    gyro_bias_drift: Positive = 2e-3  # rad/s: a choice
    accel_scale: Positive = 0.03  # -: MPU-6050 ±3 %
    accel_misalignment: Positive = 0.02  # -: MPU-6050 ±2 %, and a degree as above
    accel_quadratic: Positive = 1e-3  # s²/m: MPU-6050 0.5 % of a full scale of 2 g
    accel_bias_drift: Positive = 0.1  # m/s²: a choice
    clock_offset: Positive = 0.01  # s: a choice

    def std_of(self, effect: LinearForm) -> Float64[np.ndarray, " p"]:
        """Standard deviation of the prior of each parameter of an effect."""
        same: float | None = getattr(self, effect.name, None)
        return effect.plausible if same is None else np.full(len(effect.parameters), same)


class TrainSettings(Settings, frozen=True):
    """How to train; `model` holds the settings of the method.

    `imutool/bias/METHOD.py`, class Config. The defaults here are those of linear and neural_ode; `settings_of` has those of any
    method.
    """

    seed: Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)] = 0  # of the random numbers: first weights, batches
    gyro_window_s: Lengths = (1.0, 4.0, 15.0)  # windows between true poses whose end the attitude has to reach
    accel_window_s: Lengths = (0.5, 2.0)  # the same for the velocity
    samples: Count = 8_000  # in a step, of windows from all logs
    steps: Count = 300  # of the descent of one sensor
    gyro_rate: Positive = 1e-2  # learning rate of the gyro's descent
    accel_rate: Positive = 3e-3  # the same for the accelerometer
    weight_decay: Annotated[float, msgspec.Meta(ge=0)] = 1e-4  # of AdamW
    track_knot_s: Positive = 20.0  # between knots of each log's own slow bias, which the training estimates with the weights
    validate_every: Count = 100  # steps between two lines of progress, each with a checkpoint
    max_samples: Count = 1_000_000  # of all logs together, each from its start: one takes 3 kB of memory
    compare: bool = True  # all but neural_ode: score left-out logs, and keep the simplest model that is not beaten
    increments: IncrementSettings = IncrementSettings()
    paper: PaperSettings = PaperSettings()
    pose_floors: PoseFloors = PoseFloors()
    sensors: SensorPrior = SensorPrior()
    model: dict[str, Any] = msgspec.field(default_factory=dict)  # settings of the method, below; `model.` may be left out

    @property
    def window_s(self) -> dict[Sensor, tuple[float, ...]]:
        """Lengths of the windows of each sensor."""
        return {"gyro": self.gyro_window_s, "accel": self.accel_window_s}


@functools.cache
def settings_of(method: str) -> type[TrainSettings]:
    """`TrainSettings` with the defaults that a method prefers (`BiasNetwork.prefers`).

    Raises:
        ConfigError: unknown method.
    """
    prefers = registry.load("imutool.networks", method, "method").Network.prefers
    if not prefers:
        return TrainSettings
    kinds = {field.name: field.type for field in msgspec.structs.fields(TrainSettings)}
    fields = [(name, kinds[name], default) for name, default in prefers.items()]
    made = msgspec.defstruct(
        f"TrainSettings_{method}", fields, bases=(TrainSettings,), frozen=True, kw_only=True, forbid_unknown_fields=True
    )
    assert issubclass(made, TrainSettings)
    return made


def settings_for(method: str, given: TrainSettings | None) -> TrainSettings:
    """The settings given, or the method's defaults.

    Raises:
        ConfigError: unknown method, or settings whose defaults are another method's: they would train without a word, badly.
    """
    kind = settings_of(method)
    if given is None:
        return kind()
    if type(given) is not kind:
        raise ConfigError(
            f"settings of type {type(given).__name__}",
            where=f"training {method}",
            expected=kind.__name__,
            fix=f"Build them with imutool.training.settings.settings_of({method!r})",
        )
    return given


def full_name(method: str, key: str) -> str:
    """Full name of a setting, `key` or `key=value`.

    The method's own may be named without `model.`.

    Raises:
        ConfigError: unknown method.
    """
    first = re.split("[.=]", key, maxsplit=1)[0]
    of_method = {field.name for field in msgspec.structs.fields(registry.load("imutool.bias", method).Config)}
    return f"model.{key}" if first in of_method - {field.name for field in msgspec.structs.fields(TrainSettings)} else key


def placed(method: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings with the method's own in their place, under `model`.

    Raises:
        ConfigError: unknown method, or no mapping.
    """
    given: object = settings
    if not isinstance(given, Mapping):
        raise ConfigError(f"is of type {type(given).__name__}", where="settings", expected="a dictionary")
    general = {key: value for key, value in settings.items() if full_name(method, key) == key}
    own = {key: value for key, value in settings.items() if key not in general}
    return {**general, "model": {**general.get("model", {}), **own}} if own else general


def settings_from_physics(physics: Path) -> tuple[list[str], tuple[str, ...]]:
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
