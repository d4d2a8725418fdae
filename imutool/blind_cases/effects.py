"""Forward models of what a sealed case may conceal, one by one straight from the catalogue's formulas.

A model acts at its stage, in the order in which a signal meets them; within a stage by name. Up to CONVERTER a signal is an
array of six columns: gyro (rad/s), then accel (m/s²). The estimator has forward models of its own, and none of these.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from jaxtyping import Float64

from imutool.blind_cases.filters import first_order, mount
from imutool.blind_cases.motion import Felt
from imutool.recording import GRAVITY_M_S2

Theta = Float64[np.ndarray, " _"]  # each effect has its own number of parameters
Six = Float64[np.ndarray, "n 6"]
Times = Float64[np.ndarray, " n"]
AXES = "xyz"
PAIRS = tuple(a + b for a in AXES for b in AXES)
EARTH_RAD_S = 7.292115e-5
TEMPERATURE = "/imu0/temperature"
T0_C = 25.0
NO_LIMIT = 1e9  # a sensor that never clips
CLIPPED_PERCENT = 5.0
GYRO, ACCEL = slice(0, 3), slice(3, 6)


class Stage(IntEnum):
    """When a model acts."""

    FELT = 0
    MOUNT = 1
    BANDWIDTH = 2
    CLOCK = 3
    SENSOR = 4
    CONVERTER = 5
    STAMPS = 6
    REFERENCE = 7


@dataclass(frozen=True)
class Parameter:
    """A number of a model; `amount` says whether it grows with the size of the effect (a time or a frequency does not)."""

    name: str
    unit: str
    plausible: float
    amount: bool = True


@dataclass(frozen=True)
class Reading:
    """What a SENSOR model may look at: seconds since the log's start, what arrives, and the log's other channels."""

    t_s: Times
    signal: Six
    channels: Mapping[str, Times]


@dataclass(frozen=True)
class Model:
    """One effect. `signal`: gyro, accel or both; `driver`: the topic it follows, where it does.

    act: FELT (Felt, theta) -> Six of what it adds; MOUNT and BANDWIDTH (rate_hz, Six, theta) -> Six; CLOCK (t, theta) -> t;
    SENSOR (Reading, theta) -> Six; CONVERTER (Six, theta) -> Six; STAMPS and REFERENCE are done by the scene.
    strengthen: parameters at another size, where that is more than multiplying the amounts.
    """

    name: str
    stage: Stage
    signal: str
    parameters: tuple[Parameter, ...]
    act: Callable[..., Any]
    strengthen: Callable[[Theta, float, Six], Theta] | None = None
    driver: str = ""
    equation: str = ""
    smooth: bool = True  # in its parameters, so that information has a meaning

    @property
    def plausible(self) -> Theta:
        """The plausible size of each parameter."""
        return np.array([parameter.plausible for parameter in self.parameters])

    @property
    def amounts(self) -> np.ndarray:
        """Which parameters grow with the size."""
        return np.array([parameter.amount for parameter in self.parameters])

    def sized(self, theta: Theta, size: float, signal: Six) -> Theta:
        """Parameters that were drawn at the plausible size, at another; `signal` is the ideal one."""
        if self.strengthen is not None:
            return self.strengthen(theta, size, signal)
        return np.where(self.amounts, theta * size, theta)


def _axes(unit: str, plausible: float, prefix: str = "") -> tuple[Parameter, ...]:
    return tuple(Parameter(prefix + axis, unit, plausible) for axis in AXES)


def _matrix(unit: str, plausible: float, *, diagonal: bool) -> tuple[Parameter, ...]:
    return tuple(Parameter(pair, unit, plausible) for pair in PAIRS if diagonal or pair[0] != pair[1])


# ── what the point where the sensor sits feels ──


def _lever(felt: Felt, r: Theta) -> Six:
    """alpha x r + omega x (omega x r)."""
    return _on_accel(np.cross(felt.alpha, r) + np.cross(felt.omega, np.cross(felt.omega, r)))


def _size(felt: Felt, theta: Theta) -> Six:
    """Axis i of the accelerometer sits at r_i: row i of theta."""
    added = np.zeros_like(felt.f)
    for axis, r in enumerate(theta.reshape(3, 3)):
        added[:, axis] = _lever(felt, r)[:, 3 + axis]
    return _on_accel(added)


def _gravity(felt: Felt, theta: Theta) -> Six:
    """The world pulls with g + dg, upwards along Exp(tilt_x, tilt_y, 0) e_z."""
    tilt = np.array([theta[1], theta[2], 0.0])
    angle = float(np.linalg.norm(tilt))
    e_z = np.array([0.0, 0.0, 1.0])
    up = e_z
    if angle > 0.0:
        axis = tilt / angle
        up = e_z * np.cos(angle) + np.cross(axis, e_z) * np.sin(angle)  # the axis is level: Rodrigues' third term is none
    change = (GRAVITY_M_S2 + theta[0]) * up - GRAVITY_M_S2 * e_z
    return _on_accel(np.einsum("nji,j->ni", felt.R_wb, change))


def _earth(felt: Felt, theta: Theta) -> Six:
    """omega_e (cos lat cos heading, cos lat sin heading, sin lat) in the world, z up; north is at `heading` about z from x."""
    latitude, heading = theta
    level = np.cos(latitude)
    omega_w = EARTH_RAD_S * np.array([level * np.cos(heading), level * np.sin(heading), np.sin(latitude)])
    added = np.zeros((len(felt.t_s), 6))
    added[:, GYRO] = np.einsum("nji,j->ni", felt.R_wb, omega_w)
    return added


def _vibration(felt: Felt, theta: Theta) -> Six:
    """A line: amplitude_k sin(2 pi f t + phase_k) on each of the six columns."""
    f_hz, amplitude, phase = theta[0], theta[1:7], theta[7:13]
    return np.asarray(amplitude * np.sin(2.0 * np.pi * f_hz * felt.t_s[:, None] + phase))


def _on_accel(added: Float64[np.ndarray, "n 3"]) -> Six:
    return np.asarray(np.concatenate([np.zeros_like(added), added], axis=1))


# ── mount, bandwidth, clock ──


def _rotate(rate_hz: float, signal: Six, theta: Theta) -> Six:
    """R_bi^T on both, R_bi = exp([theta]x)."""
    angle = float(np.linalg.norm(theta))
    if angle == 0.0:
        return signal
    x, y, z = theta / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    R_bi = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    return np.concatenate([signal[:, GYRO] @ R_bi, signal[:, ACCEL] @ R_bi], axis=1)


def _resonate(rate_hz: float, signal: Six, theta: Theta) -> Six:
    """Each accelerometer axis is to `share` on a spring and damper: a + share (H - 1) a."""
    out = signal.copy()
    moved = mount(signal[:, ACCEL], rate_hz, float(theta[0]), float(theta[1])) - signal[:, ACCEL]
    out[:, ACCEL] += theta[2:5] * moved
    return out


def _low_pass(rate_hz: float, signal: Six, theta: Theta) -> Six:
    return first_order(signal, rate_hz, float(theta[0]))


def _jump(t_s: Times, theta: Theta) -> Times:
    return np.asarray(t_s + np.where(t_s >= theta[0], theta[1], 0.0))


# ── the sensor ──


def _scale(part: slice) -> Callable[[Reading, Theta], Six]:
    def act(reading: Reading, s: Theta) -> Six:
        return _with(reading, part, reading.signal[:, part] * (1.0 + s))

    return act


def _misalign(part: slice) -> Callable[[Reading, Theta], Six]:
    def act(reading: Reading, theta: Theta) -> Six:
        m = np.eye(3)
        m[~np.eye(3, dtype=bool)] = theta
        return _with(reading, part, reading.signal[:, part] @ m.T)

    return act


def _quadratic(part: slice) -> Callable[[Reading, Theta], Six]:
    def act(reading: Reading, k: Theta) -> Six:
        return _with(reading, part, reading.signal[:, part] * (1.0 + k * reading.signal[:, part]))

    return act


def _warm_up(part: slice) -> Callable[[Reading, Theta], Six]:
    def act(reading: Reading, theta: Theta) -> Six:
        rise = 1.0 - np.exp(-reading.t_s[:, None] / theta[3])
        return _with(reading, part, reading.signal[:, part] + rise * theta[:3])

    return act


def _g_sensitive(reading: Reading, theta: Theta) -> Six:
    return _with(reading, GYRO, reading.signal[:, GYRO] + reading.signal[:, ACCEL] @ theta.reshape(3, 3).T)


def _temperature(reading: Reading, k: Theta) -> Six:
    return np.asarray(reading.signal + (reading.channels[TEMPERATURE] - T0_C)[:, None] * k)


def _with(reading: Reading, part: slice, values: Float64[np.ndarray, "n 3"]) -> Six:
    out = reading.signal.copy()
    out[:, part] = values
    return out


# ── the converter ──


def _saturate(signal: Six, theta: Theta) -> Six:
    limits = np.repeat(theta, 3)
    return np.asarray(np.clip(signal, -limits, limits))


def _quantize(signal: Six, theta: Theta) -> Six:
    lsb = np.repeat(theta, 3)
    return np.where(lsb > 0.0, np.round(signal / np.where(lsb > 0.0, lsb, 1.0)) * lsb, signal)


def _nothing(*_: Any) -> None:
    """Done by the scene."""


def _tau(unit: str = "s") -> Parameter:
    return Parameter("tau", unit, 30.0, amount=False)


def _quicker(theta: Theta, size: float, signal: Six) -> Theta:
    """A cut-off grows as the effect shrinks: its time constant is the amount."""
    return theta / size


def clipping(theta: Theta, size: float, signal: Six) -> Theta:
    """Limits that clip the largest axis 5 % of the time at the plausible size, a quarter of that at a quarter of it."""
    share = 100.0 - CLIPPED_PERCENT * size
    at = np.array([np.percentile(np.abs(signal[:, part]).max(axis=1), share) for part in (GYRO, ACCEL)])
    return np.where(theta < NO_LIMIT, at, NO_LIMIT)


_LINE = (
    Parameter("f", "Hz", 40.0, amount=False),
    *_axes("rad/s", 0.1, "gyro_"),
    *_axes("m/s^2", 1.0, "accel_"),
    *(Parameter(f"phase_{k}", "rad", 1.0, amount=False) for k in range(6)),
)

CATALOGUE: Mapping[str, Model] = {
    model.name: model
    for model in (
        Model("gyro_scale", Stage.SENSOR, "gyro", _axes("-", 0.1), _scale(GYRO)),
        Model("gyro_misalignment", Stage.SENSOR, "gyro", _matrix("-", 0.05, diagonal=False), _misalign(GYRO)),
        Model("gyro_g_sensitivity", Stage.SENSOR, "gyro", _matrix("rad/s per m/s^2", 3e-3, diagonal=True), _g_sensitive),
        Model("gyro_quadratic", Stage.SENSOR, "gyro", _axes("s/rad", 0.1), _quadratic(GYRO)),
        Model("gyro_bias_drift", Stage.SENSOR, "gyro", (*_axes("rad/s", 0.02), _tau()), _warm_up(GYRO)),
        Model("accel_scale", Stage.SENSOR, "accel", _axes("-", 0.05), _scale(ACCEL)),
        Model("accel_misalignment", Stage.SENSOR, "accel", _matrix("-", 0.05, diagonal=False), _misalign(ACCEL)),
        Model("accel_quadratic", Stage.SENSOR, "accel", _axes("s^2/m", 6e-3), _quadratic(ACCEL)),
        Model("accel_bias_drift", Stage.SENSOR, "accel", (*_axes("m/s^2", 0.5), _tau()), _warm_up(ACCEL)),
        Model("lever_arm", Stage.FELT, "accel", _axes("m", 0.3), _lever),
        Model("mount_rotation", Stage.MOUNT, "both", _axes("rad", 0.2), _rotate),
        Model("size_effect", Stage.FELT, "accel", _matrix("m", 0.02, diagonal=True), _size),
        Model("clock_offset", Stage.CLOCK, "both", (Parameter("tau", "s", 0.05),), lambda t, theta: t + theta[0]),
        Model("clock_skew", Stage.CLOCK, "both", (Parameter("eps", "-", 1e-3),), lambda t, theta: t * (1.0 + theta[0])),
        Model(
            "clock_jump",
            Stage.CLOCK,
            "both",
            (Parameter("t_j", "s", 30.0, amount=False), Parameter("step", "s", 0.05)),
            _jump,
            smooth=False,
        ),
        Model("low_pass", Stage.BANDWIDTH, "both", (Parameter("f_c", "Hz", 5.0),), _low_pass, _quicker),
        Model(
            "saturation",
            Stage.CONVERTER,
            "both",
            (Parameter("gyro", "rad/s", 2.0), Parameter("accel", "m/s^2", 12.0)),
            _saturate,
            clipping,
            smooth=False,
        ),
        Model(
            "quantization",
            Stage.CONVERTER,
            "both",
            (Parameter("gyro", "rad/s", 0.02), Parameter("accel", "m/s^2", 0.2)),
            _quantize,
            smooth=False,
        ),
        Model(
            "gravity",
            Stage.FELT,
            "accel",
            (Parameter("g", "m/s^2", 0.05), Parameter("tilt_x", "rad", 0.05), Parameter("tilt_y", "rad", 0.05)),
            _gravity,
        ),
        Model(
            "earth_rotation",
            Stage.FELT,
            "gyro",
            (Parameter("latitude", "rad", 1.0, amount=False), Parameter("heading", "rad", 1.0, amount=False)),
            _earth,
        ),
        Model("vibration", Stage.FELT, "both", _LINE, _vibration),
        Model(
            "mount_resonance",
            Stage.MOUNT,
            "accel",
            (
                Parameter("f0", "Hz", 15.0, amount=False),
                Parameter("zeta", "-", 0.2, amount=False),
                *_axes("-", 1.0, "share_"),
            ),
            _resonate,
        ),
        Model(
            "temperature",
            Stage.SENSOR,
            "both",
            (*_axes("rad/s/K", 1e-3, "gyro_"), *_axes("m/s^2/K", 1e-2, "accel_")),
            _temperature,
        ),
        Model("dropped_samples", Stage.STAMPS, "both", (Parameter("share", "-", 0.02),), _nothing, smooth=False),
        Model("timestamp_jitter", Stage.STAMPS, "both", (Parameter("std", "s", 2e-3),), _nothing, smooth=False),
        Model(
            "reference_error",
            Stage.REFERENCE,
            "both",
            (
                Parameter("length", "s", 2.0),
                *(Parameter(f"t_{k}", "s", 30.0, amount=False) for k in range(3)),
            ),
            _nothing,
            smooth=False,
        ),
    )
}
