"""Catalogue of the effects that a blind case may conceal: sizes, named and unnamed ones.

Unnamed are odd terms of the signals, and columns that another channel drives.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.random import Generator

from imutool.array_types import Rows6, Vectors
from imutool.blind_cases import effects as forward
from imutool.blind_cases.effects import (
    ACCEL,
    GYRO,
    TEMPERATURE,
    Model,
    Parameter,
    Reading,
    Stage,
    Theta,
    Times,
    on,
)

RATE_HZ = 50.0  # of the channels
LONGEST_LAG_S = 0.3
KNEE_RAD_S = 0.3
TOPICS: Mapping[str, str] = {
    "/battery/voltage": "V",
    "/imu0/temperature": "degC",
    "/motor/current": "A",
    "/rotor/speed": "rad/s",
    "/servo/position": "rad",
}
DRIVERS = tuple(topic for topic in TOPICS if topic != TEMPERATURE)
AXES = "xyz"
PAIRS = tuple(a + b for a in AXES for b in AXES)
NO_LIMIT = 1e9  # a sensor that never clips
CLIPPED_PERCENT = 5.0


def clipping(theta: Theta, size: float, signal: Rows6) -> Theta:
    """Limits that clip the largest axis 5 % of the time at the plausible size, else less."""
    share = 100.0 - CLIPPED_PERCENT * size
    at = np.array([np.percentile(np.abs(signal[:, part]).max(axis=1), share) for part in (GYRO, ACCEL)])
    return np.where(theta < NO_LIMIT, at, NO_LIMIT)


def _quicker(theta: Theta, size: float, signal: Rows6) -> Theta:
    """A cut-off grows as the effect shrinks: its time constant is the amount."""
    return theta / size


def _axes(unit: str, plausible: float, prefix: str = "") -> tuple[Parameter, ...]:
    return tuple(Parameter(prefix + axis, unit, plausible) for axis in AXES)


def _matrix(unit: str, plausible: float, *, diagonal: bool) -> tuple[Parameter, ...]:
    return tuple(Parameter(pair, unit, plausible) for pair in PAIRS if diagonal or pair[0] != pair[1])


def _fixed(name: str, unit: str, plausible: float) -> Parameter:
    """A time or a frequency, which does not grow with the size."""
    return Parameter(name, unit, plausible, amount=False)


def _by_scene(*_: Any) -> None:
    """Stamps and reference are the scene's."""


def quadratic(values: Vectors, k: Theta, t_s: Times) -> Vectors:
    """(1 + k v) v."""
    return np.asarray(values * (1.0 + k * values))


def two_gains(values: Vectors, a: Theta, t_s: Times) -> Vectors:
    """(1 + a / 2) v where v is positive, (1 - a / 2) v where it is negative."""
    return np.where(values > 0.0, values * (1.0 + 0.5 * a), values * (1.0 - 0.5 * a))


def dead_band(values: Vectors, width: Theta, t_s: Times) -> Vectors:
    """Zero below the width."""
    return np.where(np.abs(values) < width[0], 0.0, values)


def play(values: Vectors, width: Theta, t_s: Times) -> Vectors:
    """What a reading is dragged along by, with so much play on both sides."""
    out, dragged = np.empty_like(values), values[0]
    for k, value in enumerate(values):
        dragged = np.minimum(np.maximum(dragged, value - width[0]), value + width[0])
        out[k] = dragged
    return out


_LINE = (
    _fixed("f", "Hz", 40.0),
    *_axes("rad/s", 0.1, "gyro_"),
    *_axes("m/s^2", 1.0, "accel_"),
    *(_fixed(f"phase_{k}", "rad", 1.0) for k in range(6)),
)
_TAU = _fixed("tau", "s", 30.0)
_AT = _fixed("t_step", "s", 30.0)
_LIMITS = (Parameter("gyro", "rad/s", 2.0), Parameter("accel", "m/s^2", 12.0))
_LSB = (Parameter("gyro", "rad/s", 0.02), Parameter("accel", "m/s^2", 0.2))
_JUMP = (_fixed("t_j", "s", 30.0), Parameter("step", "s", 0.05))
_GRAVITY = (Parameter("g", "m/s^2", 0.05), Parameter("tilt_x", "rad", 0.05), Parameter("tilt_y", "rad", 0.05))
_RESONANCE = (_fixed("f0", "Hz", 15.0), _fixed("zeta", "-", 0.2), *_axes("-", 1.0, "share_"))
_LOST = (Parameter("length", "s", 2.0), *(_fixed(f"t_{k}", "s", 30.0) for k in range(3)))
_G = _matrix("rad/s per m/s^2", 3e-3, diagonal=True)
_SQUARE = _matrix("-", 0.05, diagonal=False)

CATALOGUE: Mapping[str, Model] = {
    model.name: model
    for model in (
        Model("gyro_scale", Stage.SENSOR, "gyro", _axes("-", 0.1), on(GYRO, forward.scale)),
        Model("gyro_scale_asymmetry", Stage.SENSOR, "gyro", _axes("-", 0.1), on(GYRO, two_gains)),
        Model("gyro_misalignment", Stage.SENSOR, "gyro", _SQUARE, on(GYRO, forward.misalignment)),
        Model("gyro_g_sensitivity", Stage.SENSOR, "gyro", _G, forward.g_sensitivity),
        Model("gyro_quadratic", Stage.SENSOR, "gyro", _axes("s/rad", 0.1), on(GYRO, quadratic)),
        Model("gyro_bias_drift", Stage.SENSOR, "gyro", (*_axes("rad/s", 0.02), _TAU), on(GYRO, forward.warm_up)),
        Model("gyro_bias_step", Stage.SENSOR, "gyro", (*_axes("rad/s", 0.02), _AT), on(GYRO, forward.bias_step)),
        Model("accel_scale", Stage.SENSOR, "accel", _axes("-", 0.05), on(ACCEL, forward.scale)),
        Model("accel_scale_asymmetry", Stage.SENSOR, "accel", _axes("-", 0.05), on(ACCEL, two_gains)),
        Model("accel_misalignment", Stage.SENSOR, "accel", _SQUARE, on(ACCEL, forward.misalignment)),
        Model("accel_quadratic", Stage.SENSOR, "accel", _axes("s^2/m", 6e-3), on(ACCEL, quadratic)),
        Model("accel_bias_drift", Stage.SENSOR, "accel", (*_axes("m/s^2", 0.5), _TAU), on(ACCEL, forward.warm_up)),
        Model("accel_bias_step", Stage.SENSOR, "accel", (*_axes("m/s^2", 0.5), _AT), on(ACCEL, forward.bias_step)),
        Model("lever_arm", Stage.IDEAL, "accel", _axes("m", 0.3), forward.lever_arm),
        Model("mount_rotation", Stage.MOUNT, "both", _axes("rad", 0.2), forward.mount_rotation),
        Model("size_effect", Stage.IDEAL, "accel", _matrix("m", 0.02, diagonal=True), forward.size_effect),
        Model("clock_offset", Stage.CLOCK, "both", (Parameter("tau", "s", 0.05),), lambda t, theta: t + theta[0]),
        Model("clock_skew", Stage.CLOCK, "both", (Parameter("eps", "-", 1e-3),), lambda t, theta: t * (1.0 + theta[0])),
        Model("clock_jump", Stage.CLOCK, "both", _JUMP, forward.clock_jump, smooth=False),
        Model("low_pass", Stage.BANDWIDTH, "both", (Parameter("f_c", "Hz", 5.0),), forward.low_pass, _quicker),
        Model("gyro_delay", Stage.BANDWIDTH, "gyro", (Parameter("tau", "s", 5e-3),), forward.gyro_delay),
        Model("gyro_hysteresis", Stage.SENSOR, "gyro", (Parameter("width", "rad/s", 0.02),), on(GYRO, play)),
        Model("accel_hysteresis", Stage.SENSOR, "accel", (Parameter("width", "m/s^2", 0.2),), on(ACCEL, play)),
        Model(
            "gyro_dead_band",
            Stage.SENSOR,
            "gyro",
            (Parameter("width", "rad/s", 0.05),),
            on(GYRO, dead_band),
            smooth=False,
        ),
        Model("saturation", Stage.CONVERTER, "both", _LIMITS, forward.saturation, clipping, smooth=False),
        Model("quantization", Stage.CONVERTER, "both", _LSB, forward.quantization, smooth=False),
        Model("gravity", Stage.IDEAL, "accel", _GRAVITY, forward.gravity),
        Model(
            "earth_rotation",
            Stage.IDEAL,
            "gyro",
            (_fixed("latitude", "rad", 1.0), _fixed("heading", "rad", 1.0)),
            forward.earth_rotation,
        ),
        Model("vibration", Stage.IDEAL, "both", _LINE, forward.vibration),
        Model("mount_resonance", Stage.MOUNT, "accel", _RESONANCE, forward.mount_resonance),
        Model(
            "temperature",
            Stage.SENSOR,
            "both",
            (*_axes("rad/s/K", 1e-3, "gyro_"), *_axes("m/s^2/K", 1e-2, "accel_")),
            forward.temperature,
        ),
        Model("dropped_samples", Stage.STAMPS, "both", (Parameter("share", "-", 0.02),), _by_scene, smooth=False),
        Model("timestamp_jitter", Stage.STAMPS, "both", (Parameter("std", "s", 2e-3),), _by_scene, smooth=False),
        Model("reference_error", Stage.REFERENCE, "both", _LOST, _by_scene, smooth=False),
    )
}


# ── without a name ──


def channels(rng: Generator, t_s: Times, motion: Rows6) -> dict[str, Times]:
    """Other channels of a log, on their own clock.

    `motion` are the samples of an ideal IMU at these times, which the rotor follows a little. Every case has all channels,
    whether an effect follows one or not. The voltage sags with the current, as a decoy.
    """
    dt = float(t_s[1] - t_s[0])
    current = 4.0 + 1.5 * _wander(rng, len(t_s), 0.6, dt) + 2.0 * (_wander(rng, len(t_s), 2.0, dt) > 1.0)
    effort = np.linalg.norm(motion[:, 3:], axis=1)
    speed = 400.0 + 15.0 * (effort - effort.mean()) / (effort.std() + 1e-9) + 20.0 * _wander(rng, len(t_s), 0.3, dt)
    voltage = 16.5 - 0.004 * t_s - 0.05 * (current - 4.0) + 0.08 * _wander(rng, len(t_s), 1.0, dt)
    steps = rng.uniform(-0.8, 0.8, int(t_s[-1] / 2.0) + 2)
    servo = steps[np.clip((t_s + rng.uniform(0.0, 2.0)) / 2.0, 0, len(steps) - 1).astype(int)]
    fan = _wander(rng, len(t_s), 6.0, dt)
    temperature = 26.0 + 6.0 * (1.0 - np.exp(-t_s / rng.uniform(20.0, 60.0))) + 2.0 * fan
    return {
        "/battery/voltage": voltage,
        "/imu0/temperature": temperature,
        "/motor/current": current,
        "/rotor/speed": speed,
        "/servo/position": servo,
    }


def _wander(rng: Generator, count: int, memory_s: float, dt: float) -> Times:
    """Unit noise with a memory, smoothed once more so that it has a slope."""
    keep = np.exp(-dt / memory_s)
    white = rng.standard_normal(count + 400)
    out = np.zeros(count + 400)
    once = 0.0
    for k, value in enumerate(white):
        once = keep * once + (1.0 - keep) * value
        out[k] = keep * out[k - 1] + (1.0 - keep) * once
    out = out[400:]
    wandered: Times = (out - out.mean()) / (out.std() + 1e-12)
    return wandered


def driven(rng: Generator, spread: Mapping[str, float]) -> tuple[Model, Theta]:
    """Column that follows a channel: + gain c(t - lag), as large as is plausible."""
    topic = DRIVERS[rng.integers(len(DRIVERS))]
    column = int(rng.integers(6))
    gain = (0.05 if column < 3 else 0.5) / spread[topic]
    theta = np.array([gain * rng.choice([-1.0, 1.0]), rng.uniform(0.0, LONGEST_LAG_S)])
    return follower(topic, column, gain), theta


def follower(topic: str, column: int, gain: float = 1.0) -> Model:
    """Model of a column (of six) that follows a channel; `gain` is its plausible size."""
    sensor = "gyro" if column < 3 else "accel"
    unit = f"{'rad/s' if column < 3 else 'm/s^2'} per {TOPICS[topic]}"

    def act(reading: Reading, theta: Theta) -> Rows6:
        out = reading.signal.copy()
        out[:, column] += theta[0] * np.interp(reading.t_s - theta[1], reading.t_s, reading.channels[topic])
        return out

    parameters = (Parameter("gain", unit, gain), Parameter("lag", "s", LONGEST_LAG_S, amount=False))
    equation = f"{sensor}.{AXES[column % 3]} += gain * {topic}(t - lag)"
    return Model("driven", Stage.SENSOR, sensor, parameters, act, driver=topic, equation=equation)


Term = Callable[[Rows6, Times, int], Times]


def _hysteresis(u: Rows6, t_s: Times, i: int) -> Times:
    return np.asarray(np.sign(np.gradient(u[:, i], t_s)))


def _dead_band(u: Rows6, t_s: Times, i: int) -> Times:
    return np.where(np.abs(u[:, i]) < KNEE_RAD_S, -u[:, i], 0.0)


# name: (input sensor, output sensor, plausible, unit, equation, term)
FORMS: Mapping[str, tuple[str, str, float, str, str, Term]] = {
    "tanh": ("gyro", "gyro", 0.1, "rad/s", "c tanh(omega_{i} / 0.3)", lambda u, t, i: np.tanh(u[:, i] / KNEE_RAD_S)),
    "product": ("gyro", "gyro", 0.1, "s/rad", "c omega_{i} omega_{j}", lambda u, t, i: u[:, i] * u[:, (i + 1) % 3]),
    "cubic": ("accel", "accel", 5e-4, "s^4/m^2", "c f_{i}^3", lambda u, t, i: u[:, 3 + i] ** 3),
    "hysteresis": ("gyro", "gyro", 0.03, "rad/s", "c sign(d omega_{i}/dt)", _hysteresis),
    "modulus": ("gyro", "accel", 0.3, "m s/rad", "c |omega_{i}|", lambda u, t, i: np.abs(u[:, i])),
    "mixed": ("gyro", "accel", 0.03, "s/rad", "c f_{j} omega_{i}", lambda u, t, i: u[:, i] * u[:, 3 + (i + 1) % 3]),
    "dead_band": ("gyro", "gyro", 0.5, "-", "-c omega_{i} where |omega_{i}| < 0.3", _dead_band),
}


def unknown(rng: Generator, form: str | None) -> tuple[Model, Theta]:
    """Odd term of the signals on one column, at the plausible size."""
    name = form or sorted(FORMS)[rng.integers(len(FORMS))]
    _, output, large, unit, equation, term = FORMS[name]
    i, out_axis = int(rng.integers(3)), int(rng.integers(3))
    if name in {"dead_band", "cubic", "hysteresis"}:
        out_axis = i
    column = out_axis + (0 if output == "gyro" else 3)

    def act(reading: Reading, theta: Theta) -> Rows6:
        out = reading.signal.copy()
        out[:, column] += theta[0] * term(reading.signal, reading.t_s, i)
        return out

    text = equation.format(i=AXES[i], j=AXES[(i + 1) % 3])
    sentence = f"{output}.{AXES[out_axis]} += {text}"
    model = Model("unknown", Stage.SENSOR, output, (Parameter("c", unit, large),), act, equation=sentence)
    return model, np.array([large * rng.choice([-1.0, 1.0])])
