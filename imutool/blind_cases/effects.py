"""Forward models of the effects that a blind case may conceal.

They follow the catalogue's formulas. A model acts at its stage, in the order in which a signal passes them; `scene` has the
order within one. Up to CONVERTER a signal is an array of six columns: gyro (rad/s), then accel (m/s²). The estimator has
forward models of its own and uses none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.signal import cont2discrete, lfilter, lfilter_zi

from imutool.array_types import Float64, Rows6, Vectors
from imutool.blind_cases.motion import Kinematics
from imutool.recording import GRAVITY_M_S2

Theta = Float64[np.ndarray, " _"]  # each effect has its own number of parameters
Columns = Float64[np.ndarray, "n k"]
Times = Float64[np.ndarray, " n"]
EARTH_RAD_S = 7.292115e-5
TEMPERATURE = "/imu0/temperature"
T0_C = 25.0
GYRO, ACCEL = slice(0, 3), slice(3, 6)


class Stage(IntEnum):
    """Stage at which a model acts."""

    IDEAL = 0
    MOUNT = 1
    BANDWIDTH = 2
    CLOCK = 3
    SENSOR = 4
    CONVERTER = 5
    STAMPS = 6
    REFERENCE = 7


@dataclass(frozen=True)
class Parameter:
    """Parameter of a model; an `amount` (no time or frequency) grows with the effect's size."""

    name: str
    unit: str
    plausible: float
    amount: bool = True


@dataclass(frozen=True)
class Reading:
    """Input of a SENSOR model: seconds from the log's start, the signal, and other channels."""

    t_s: Times
    signal: Rows6
    channels: Mapping[str, Times]


@dataclass(frozen=True)
class Model:
    """Forward model of one effect.

    Attributes:
        signal: gyro, accel or both.
        act: IDEAL (Kinematics, theta) -> Rows6 that is added; MOUNT and BANDWIDTH (rate_hz, Rows6, theta) -> Rows6; CLOCK
            (t, theta) -> t; SENSOR (Reading, theta) -> Rows6; CONVERTER (Rows6, theta) -> Rows6. STAMPS and REFERENCE: by
            the scene.
        strengthen: parameters at another size, where that is more than multiplying the amounts.
        driver: the topic that it follows, if any.
        smooth: differentiable in its parameters, as Fisher's information requires.
    """

    name: str
    stage: Stage
    signal: str
    parameters: tuple[Parameter, ...]
    act: Callable[..., Any]
    strengthen: Callable[[Theta, float, Rows6], Theta] | None = None
    driver: str = ""
    equation: str = ""
    smooth: bool = True

    @property
    def plausible(self) -> Theta:
        """Plausible size of each parameter."""
        return np.array([parameter.plausible for parameter in self.parameters])

    @property
    def amounts(self) -> np.ndarray:
        """Mask of the parameters that grow with the size."""
        return np.array([parameter.amount for parameter in self.parameters])

    def sized(self, theta: Theta, size: float, signal: Rows6) -> Theta:
        """Parameters at another size than the plausible one; `signal` is the ideal one."""
        if self.strengthen is not None:
            return self.strengthen(theta, size, signal)
        return np.where(self.amounts, theta * size, theta)


# ── at the point where the sensor sits ──


def lever_arm(ideal: Kinematics, r: Theta) -> Rows6:
    """alpha x r + omega x (omega x r)."""
    return _on_accel(np.cross(ideal.alpha, r) + np.cross(ideal.omega, np.cross(ideal.omega, r)))


def size_effect(ideal: Kinematics, theta: Theta) -> Rows6:
    """Lever arm of each accelerometer axis: axis i sits at r_i, row i of theta."""
    added = np.zeros_like(ideal.f)
    for axis, r in enumerate(theta.reshape(3, 3)):
        added[:, axis] = lever_arm(ideal, r)[:, 3 + axis]
    return _on_accel(added)


def gravity(ideal: Kinematics, theta: Theta) -> Rows6:
    """Gravity g + dg, upwards along Exp(tilt_x, tilt_y, 0) e_z."""
    tilt = np.array([theta[1], theta[2], 0.0])
    angle = float(np.linalg.norm(tilt))
    e_z = np.array([0.0, 0.0, 1.0])
    up = e_z
    if angle > 0.0:
        axis = tilt / angle
        up = e_z * np.cos(angle) + np.cross(axis, e_z) * np.sin(angle)  # the axis is level: Rodrigues' third term is zero
    change = (GRAVITY_M_S2 + theta[0]) * up - GRAVITY_M_S2 * e_z
    return _on_accel(np.einsum("nji,j->ni", ideal.R_wb, change))


def earth_rotation(ideal: Kinematics, theta: Theta) -> Rows6:
    """omega_e, level and up, in the world, z up; north is at `heading` about z from x."""
    latitude, heading = theta
    level = np.cos(latitude)
    omega_w = EARTH_RAD_S * np.array([level * np.cos(heading), level * np.sin(heading), np.sin(latitude)])
    added = np.zeros((len(ideal.t_s), 6))
    added[:, GYRO] = np.einsum("nji,j->ni", ideal.R_wb, omega_w)
    return added


def vibration(ideal: Kinematics, theta: Theta) -> Rows6:
    """Line in the spectrum: amplitude_k sin(2 pi f t + phase_k) on each of the six columns."""
    f_hz, amplitude, phase = theta[0], theta[1:7], theta[7:13]
    return np.asarray(amplitude * np.sin(2.0 * np.pi * f_hz * ideal.t_s[:, None] + phase))


def _on_accel(added: Vectors) -> Rows6:
    return np.asarray(np.concatenate([np.zeros_like(added), added], axis=1))


# ── mount, bandwidth, clock ──


def mount_rotation(rate_hz: float, signal: Rows6, theta: Theta) -> Rows6:
    """R_bi^T on gyro and accel, R_bi = exp([theta]x)."""
    angle = float(np.linalg.norm(theta))
    if angle == 0.0:
        return signal
    x, y, z = theta / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    R_bi = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    return np.concatenate([signal[:, GYRO] @ R_bi, signal[:, ACCEL] @ R_bi], axis=1)


def mount_resonance(rate_hz: float, signal: Rows6, theta: Theta) -> Rows6:
    """Accelerometer axes on a spring and damper, each to its `share`: a + share (H - 1) a."""
    out = signal.copy()
    moved = spring_mount(signal[:, ACCEL], rate_hz, float(theta[0]), float(theta[1])) - signal[:, ACCEL]
    out[:, ACCEL] += theta[2:5] * moved
    return out


def low_pass(rate_hz: float, signal: Rows6, theta: Theta) -> Rows6:
    """First-order low-pass with the cut-off theta[0] (Hz)."""
    return first_order(signal, rate_hz, float(theta[0]))


def gyro_delay(rate_hz: float, signal: Rows6, theta: Theta) -> Rows6:
    """The gyro's columns theta[0] (s) later, held before the first sample."""
    out, at = signal.copy(), np.arange(len(signal), dtype=np.float64)
    late = np.clip(at - theta[0] * rate_hz, 0.0, at[-1])
    out[:, GYRO] = make_interp_spline(at, signal[:, GYRO], k=3)(late)
    return out


def clock_jump(t_s: Times, theta: Theta) -> Times:
    """t + step, from t_j on."""
    return np.asarray(t_s + np.where(t_s >= theta[0], theta[1], 0.0))


def first_order(signal: Columns, rate_hz: float, cut_off_hz: float) -> Columns:
    """H = 1 / (1 + s / (2 pi f_c)), from a steady state."""
    w = 2.0 * np.pi * cut_off_hz
    return _filtered(signal, rate_hz, [w], [1.0, w])


def spring_mount(signal: Columns, rate_hz: float, f0_hz: float, zeta: float) -> Columns:
    """Acceleration on a spring: H = (2 zeta w s + w²) / (s² + 2 zeta w s + w²) of the base's."""
    w = 2.0 * np.pi * f0_hz
    return _filtered(signal, rate_hz, [2.0 * zeta * w, w * w], [1.0, 2.0 * zeta * w, w * w])


def _filtered(signal: Columns, rate_hz: float, numerator: list[float], denominator: list[float]) -> Columns:
    """Integrates exactly for an input that is a straight line between samples (first-order hold)."""
    system: Any = (numerator, denominator)  # the stubs know five kinds of numbers, and no list of floats
    top, bottom, _ = cont2discrete(system, 1.0 / rate_hz, method="foh")
    b, a = np.ravel(top), np.ravel(bottom)
    start = lfilter_zi(b, a)[:, None] * signal[:1]
    out: Columns = np.asarray(lfilter(b, a, signal, axis=0, zi=start)[0])
    return out


# ── the sensor ──

OnOneSensor = Callable[[Vectors, Theta, Times], Vectors]


def on(part: slice, change: OnOneSensor) -> Callable[[Reading, Theta], Rows6]:
    """SENSOR model that changes the three columns of one sensor."""

    def act(reading: Reading, theta: Theta) -> Rows6:
        out = reading.signal.copy()
        out[:, part] = change(reading.signal[:, part], theta, reading.t_s)
        return out

    return act


def scale(values: Vectors, s: Theta, t_s: Times) -> Vectors:
    """(1 + s) v."""
    return values * (1.0 + s)


def misalignment(values: Vectors, theta: Theta, t_s: Times) -> Vectors:
    """(1 + M) v, M without a diagonal."""
    m = np.eye(3)
    m[~np.eye(3, dtype=bool)] = theta
    return values @ m.T


def warm_up(values: Vectors, theta: Theta, t_s: Times) -> Vectors:
    """v + b (1 - exp(-t / tau))."""
    rise = 1.0 - np.exp(-t_s[:, None] / theta[3])
    return np.asarray(values + rise * theta[:3])


def bias_step(values: Vectors, theta: Theta, t_s: Times) -> Vectors:
    """v + b from t_step on."""
    return np.where(t_s[:, None] < theta[3], values, values + theta[:3])


def g_sensitivity(reading: Reading, theta: Theta) -> Rows6:
    """Gyro + G f."""
    out = reading.signal.copy()
    out[:, GYRO] = reading.signal[:, GYRO] + reading.signal[:, ACCEL] @ theta.reshape(3, 3).T
    return out


def temperature(reading: Reading, k: Theta) -> Rows6:
    """Bias k (T - 25 °C)."""
    return np.asarray(reading.signal + (reading.channels[TEMPERATURE] - T0_C)[:, None] * k)


# ── the converter ──


def saturation(signal: Rows6, theta: Theta) -> Rows6:
    """Clips at the limits of gyro and accel."""
    limits = np.repeat(theta, 3)
    return np.asarray(np.clip(signal, -limits, limits))


def quantization(signal: Rows6, theta: Theta) -> Rows6:
    """Rounds to the LSB of gyro and accel; an LSB of zero rounds nothing."""
    lsb = np.repeat(theta, 3)
    return np.where(lsb > 0.0, np.round(signal / np.where(lsb > 0.0, lsb, 1.0)) * lsb, signal)
