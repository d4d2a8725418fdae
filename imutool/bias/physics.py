"""Bias model from a physics.toml: corrects the file's effects; the prior is the file's bias.

Scale, misalignment and the rotation of the mount are one matrix, reading = T f + b with T = (I + S)(I + M) R^T (they act in
this order), and its inverse is exact: f = (u - b) - (I - T^-1)(u - b). Everything else in closed form is of the measured
signals without the bias, instead of the true ones: right to first order in its size. The model inverts a rotation of the
mount: corrected samples are in the body's axes, not in the sensor's.
"""

from __future__ import annotations

import hashlib
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import ClassVar

import numpy as np

from imutool.array_types import Float64, Rows6, Vectors
from imutool.bias import hybrid, static
from imutool.bias.model import BiasModel, CovarianceModel, DriftStream, Shapes, Stream, Vector6
from imutool.config import Settings
from imutool.errors import ModelError
from imutool.inertial.preintegration import exp
from imutool.sensor import catalogue, physics_file
from imutool.sensor.effect import Effect, Parameter, Stage, Theta, each_pair
from imutool.sensor.effects import clock_offset
from imutool.sensor.effects.gyro_scale import T_STEP
from imutool.sensor.linear_form import LinearForm, linear_form
from imutool.sensor.physics_file import Bias, Entry, PhysicsFile
from imutool.sensor.physics_file_terms import DRIVEN
from imutool.sensor.samples import SensorSamples
from imutool.units import AXES, SENSORS, Sensor

# Spread of a bias from run to run: of the ADIS16448 in EuRoC's training sequences, 2 mrad/s and 0.02 m/s². Where the file
# has no bias: data sheet of a consumer sensor, as in `imutool.bias.static`.
TURN_ON_STD, UNKNOWN_STD = (2e-3, 0.02), (0.05, 0.4)
MAX_TAU_S = 0.01  # for a larger clock offset the derivative's noise exceeds the removed error
MOUNT = "mount_rotation"
MATRIX = {  # effects that are a factor of a sensor's matrix
    "gyro_scale": "gyro",
    "gyro_misalignment": "gyro",
    "accel_scale": "accel",
    "accel_misalignment": "accel",
}
# a delay of the gyro as a clock of the gyro alone, whose error is linear in its own samples
LATE_GYRO = replace(
    clock_offset.EFFECT, name="gyro_delay", forward=lambda taken_s, tau_s: taken_s - tau_s[0], sensors=("gyro",)
)
DRIFTS = {"gyro_bias_drift", "accel_bias_drift"}

logger = logging.getLogger(__name__)
Part = tuple[LinearForm, Theta, Theta]  # an effect, its parameters, their standard deviations


class Model(hybrid.Model):
    """Bias b = rest + E(u - b_0), b_0 the file's bias.

    An error of the initial bias stays constant.
    """

    method: ClassVar[str] = "physics"

    def __init__(self, parts: Mapping[Sensor, Sequence[Part]], bias: Bias | None, rate_hz: float) -> None:
        forms = {sensor: tuple(effect for effect, _, _ in parts[sensor]) for sensor in SENSORS}
        self._b = np.zeros(6) if bias is None else np.array([*bias.gyro, *bias.accel])
        spread = np.repeat(UNKNOWN_STD if bias is None else TURN_ON_STD, 3)
        tensors = {**static.UNTRAINED, "prior_mean": self._b, "prior_std": spread}
        for sensor in SENSORS:
            theta, std = (np.concatenate([np.zeros(0), *(part[k] for part in parts[sensor])]) for k in (1, 2))
            tensors |= {f"theta_{sensor}": theta, f"covariance_{sensor}": np.diag(std**2)}
        gyro, accel = (tuple(form.name for form in forms[sensor]) for sensor in SENSORS)
        config = hybrid.Config(gyro_effects=gyro, accel_effects=accel, remainder=False)
        super().__init__(config, rate_hz, tensors, forms)

    @classmethod
    def shapes(cls, config: Settings) -> Shapes:
        """Shapes of the statistics; those of the effects are their own."""
        return BiasModel.shapes(config)

    def stretch(self, rest: Vector6, start_s: float = math.nan) -> Stream:
        """Bias stream of the samples without the file's bias."""
        inner = super().stretch(rest, start_s)
        assert isinstance(inner, DriftStream)
        return _ShiftedStream(inner, self._b)

    def calibration_covariance(self) -> CovarianceModel | None:
        """Covariance from the parameters' standard deviations, taken as independent."""
        root_at = super().calibration_covariance()
        assert root_at is not None
        return partial(_shifted, root_at, self._b)


def _shifted(
    root_at: CovarianceModel,
    b: Vector6,
    t_s: Float64[np.ndarray, " n"],
    gyro: Vectors,
    accel: Vectors,
) -> Mapping[Sensor, Float64[np.ndarray, "n 3 p"]]:
    return root_at(t_s, gyro - b[:3], accel - b[3:])


class _ShiftedStream:
    """Stream that gets the samples minus a constant."""

    def __init__(self, inner: DriftStream, b: Vector6) -> None:
        self._inner, self._b = inner, b

    def __call__(self, t_s: Float64[np.ndarray, " n"], gyro: Vectors, accel: Vectors) -> Rows6:
        return self._inner(t_s, gyro - self._b[:3], accel - self._b[3:])

    @property
    def rest(self) -> Vector6:
        return self._inner.rest

    def one(self, t_s: float, u: Vector6) -> Vector6:
        return self._inner.one(t_s, u - self._b)


def load(path: Path, rate_hz: float) -> Model:
    """Bias model from a physics.toml at a sample rate; warns of effects that it cannot correct.

    Raises:
        ConfigError: the file is unreadable, or has an unknown name.
        ModelError: the file has no effect that a model can correct.
    """
    file = physics_file.read(path)
    parts, kept = _parts(file, path)
    if not any(parts.values()) and file.bias is None:
        listed = ", ".join(kept) or "nothing at all"
        raise ModelError(f"no effect can be corrected ({listed})", where=path, expected="a bias, or an effect in closed form")
    if kept:
        logger.warning("%s: no model corrects these effects, they stay in the samples: %s", path, ", ".join(kept))
    if file.conventions:
        found = ", ".join(file.conventions)
        logger.warning("%s holds for a log in the units and axes of its simulation; the recording had others: %s", path, found)
    if any(entry.name == MOUNT and T_STEP.name not in entry.parameters for entry in file.effect):
        logger.warning("%s: mount_rotation is inverted: corrected samples are in the body's axes, not the sensor's", path)
    model = Model(parts, file.bias, rate_hz)
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    model.card = {"name": path.stem, "sha256": sha256, "prior": f"bias of {path.name}", "not_taken": kept}
    return model


def _parts(file: PhysicsFile, where: Path) -> tuple[dict[Sensor, list[Part]], list[str]]:
    """Effects of each sensor that a model corrects, and what it does not."""
    acting = file.acting(where=where)
    parts: dict[Sensor, list[Part]] = {"gyro": [], "accel": []}
    kept = [entry.name for entry in file.effect if not _is_corrected(entry, parts)]
    without_name = acting[len(file.effect) : len(acting) - (file.bias is not None)]
    for (effect, theta), variables in zip(without_name, _variables(file), strict=True):
        if _needs_channel(variables):
            kept.append(effect.equation)
        else:
            for acted_on in (sensor for sensor in SENSORS if sensor in effect.sensors):
                parts[acted_on].append(_of_size_one(effect, theta, acted_on))
    for sensor in SENSORS:
        if (part := _matrix(file, sensor)) is not None:
            parts[sensor].append(part)
        for k, (form, theta, std) in enumerate(parts[sensor]):
            parts[sensor][k] = replace(form, recipe=(_form, (file, where, sensor, k))), theta, std
    return parts, kept


def _form(file: PhysicsFile, where: Path, sensor: Sensor, place: int) -> LinearForm:
    return _parts(file, where)[0][sensor][place][0]


def _is_corrected(entry: Entry, parts: Mapping[Sensor, list[Part]]) -> bool:
    """Whether an effect can be corrected; one with a linear form is added to the parts."""
    if T_STEP.name in entry.parameters or entry.name == DRIVEN:
        return False
    if entry.name in MATRIX or entry.name == MOUNT:
        return True
    (effect,) = (LATE_GYRO,) if entry.name == LATE_GYRO.name else catalogue.effects([entry.name])
    of_samples = effect.linear and effect.stage == Stage.SENSOR and not effect.needs  # its error follows from the samples alone
    if not (effect.trained or of_samples) or (effect.stage == Stage.CLOCK and abs(_value(entry, "tau")) > MAX_TAU_S):
        return False
    if entry.name in DRIFTS:
        fixed = (replace(parameter, fixed_in_training=_value(entry, "tau")) for parameter in effect.parameters[3:])
        effect = replace(effect, parameters=(*effect.parameters[:3], *fixed))
    for sensor in (sensor for sensor in SENSORS if sensor in effect.sensors):
        form = linear_form(effect, sensor)
        names = [effect.parameters[k].name for k in form.free]
        theta, std = (np.array([value(entry, name) for name in names]) for value in (_value, _std))
        parts[sensor].append((form, theta, std))
    return True


def _value(entry: Entry, name: str) -> float:
    """Value in the file; its null value for an absent parameter."""
    return entry.parameters[name].value if name in entry.parameters else _null_value(entry, name)


def _std(entry: Entry, name: str) -> float:
    return (entry.parameters[name].std or 0.0) if name in entry.parameters else 0.0


def _null_value(entry: Entry, name: str) -> float:
    (effect,) = catalogue.effects([entry.name])
    return next((parameter.null_value for parameter in effect.parameters if parameter.name == name), 0.0)


def _variables(file: PhysicsFile) -> list[str]:
    """Variables of each part without a name, in the order in which they act."""
    return [*(curve.variable for curve in file.unknown), *(term.term for term in file.term)]


def _needs_channel(variables: str) -> bool:
    """Whether a part needs a channel, or the time since the log's start."""
    return variables.startswith("/") or "t" in variables.replace("|", " ").split()


def _of_size_one(effect: Effect, theta: Theta, sensor: Sensor) -> Part:
    """An effect without a name as one of a single parameter, the size, that is one."""

    def forward(samples: SensorSamples, size: Theta) -> SensorSamples:
        out = effect.forward(samples, theta)
        return samples.with_readings(
            samples.gyro + size * (out.gyro - samples.gyro), samples.accel + size * (out.accel - samples.accel)
        )

    sized = replace(effect, parameters=(Parameter("size", "-", 1.0),), forward=forward)
    return linear_form(sized, sensor), np.ones(1), np.zeros(1)


def _matrix(file: PhysicsFile, sensor: Sensor) -> Part | None:
    """Effect I - T^-1 of nine parameters with standard deviations; none where T is I."""
    lasting = [entry for entry in file.effect if T_STEP.name not in entry.parameters]
    entries = {entry.name: entry for entry in lasting if MATRIX.get(entry.name) == sensor or entry.name == MOUNT}
    if not entries:
        return None
    factors, variance = [], np.zeros((3, 3))
    for name in (f"{sensor}_scale", f"{sensor}_misalignment"):
        if name in entries:
            M, std = np.zeros((3, 3)), np.zeros((3, 3))
            for i, j in np.ndindex(3, 3):
                key = AXES[i] if i == j else AXES[i] + AXES[j]
                M[i, j], std[i, j] = _value(entries[name], key), _std(entries[name], key)
            factors.append(np.eye(3) + M)
            variance += std**2
    if MOUNT in entries:
        phi, std = (np.array([value(entries[MOUNT], f"phi_{axis}") for axis in AXES]) for value in (_value, _std))
        factors.append(exp(phi).T)
        variance += np.array([[0.0, std[2], std[1]], [std[2], 0.0, std[0]], [std[1], std[0], 0.0]]) ** 2
    T = np.linalg.multi_dot([np.eye(3), np.eye(3), *factors])
    return _full(sensor), (np.eye(3) - np.linalg.inv(T)).ravel(), np.sqrt(variance).ravel()


def _full(sensor: Sensor) -> LinearForm:
    """Effect of a full matrix on the sensor's own reading."""

    def forward(samples: SensorSamples, theta: Theta) -> SensorSamples:
        A = theta.reshape(3, 3).T
        return samples.with_readings(samples.gyro + samples.gyro @ A, samples.accel + samples.accel @ A)

    equation, parameters = f"{sensor} += A {sensor}", each_pair("-", 0.1)
    effect = Effect(f"{sensor}_matrix", Stage.SENSOR, (sensor,), equation, parameters, "always", forward, trained=True)
    return linear_form(effect, sensor)
