"""Concealed effects without a name in the catalogue.

They are odd terms of the signals, and columns that another channel drives.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.random import Generator

from imutool.blind_cases.catalogue import AXES
from imutool.blind_cases.effects import Model, Parameter, Reading, Six, Stage, Theta, Times

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
DRIVERS = ("/battery/voltage", "/motor/current", "/rotor/speed", "/servo/position")


def channels(rng: Generator, t_s: Times, motion: Six) -> dict[str, Times]:
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
    """Column that follows a channel: + gain c(t - lag).

    Its plausible spread is 0.05 rad/s or 0.5 m/s².
    """
    topic = DRIVERS[rng.integers(len(DRIVERS))]
    column = int(rng.integers(6))
    gain = (0.05 if column < 3 else 0.5) / spread[topic]
    theta = np.array([gain * rng.choice([-1.0, 1.0]), rng.uniform(0.0, LONGEST_LAG_S)])
    return follower(topic, column, gain), theta


def follower(topic: str, column: int, gain: float = 1.0) -> Model:
    """Model of a column (of six) that follows a channel; `gain` is its plausible size."""
    sensor = "gyro" if column < 3 else "accel"
    unit = f"{'rad/s' if column < 3 else 'm/s^2'} per {TOPICS[topic]}"

    def act(reading: Reading, theta: Theta) -> Six:
        out = reading.signal.copy()
        out[:, column] += theta[0] * np.interp(reading.t_s - theta[1], reading.t_s, reading.channels[topic])
        return out

    parameters = (Parameter("gain", unit, gain), Parameter("lag", "s", LONGEST_LAG_S, amount=False))
    equation = f"{sensor}.{AXES[column % 3]} += gain * {topic}(t - lag)"
    return Model("driven", Stage.SENSOR, sensor, parameters, act, driver=topic, equation=equation)


Term = Callable[[Six, Times, int], Times]


def _hysteresis(u: Six, t_s: Times, i: int) -> Times:
    return np.asarray(np.sign(np.gradient(u[:, i], t_s)))


def _dead_band(u: Six, t_s: Times, i: int) -> Times:
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


def unknown(rng: Generator, form: str | None = None) -> tuple[Model, Theta]:
    """Odd term of the signals on one column, at the plausible size."""
    name = form or sorted(FORMS)[rng.integers(len(FORMS))]
    _, output, large, unit, equation, term = FORMS[name]
    i, out_axis = int(rng.integers(3)), int(rng.integers(3))
    if name in {"dead_band", "cubic", "hysteresis"}:
        out_axis = i
    column = out_axis + (0 if output == "gyro" else 3)

    def act(reading: Reading, theta: Theta) -> Six:
        out = reading.signal.copy()
        out[:, column] += theta[0] * term(reading.signal, reading.t_s, i)
        return out

    text = equation.format(i=AXES[i], j=AXES[(i + 1) % 3])
    said = f"{output}.{AXES[out_axis]} += {text}"
    model = Model("unknown", Stage.SENSOR, output, (Parameter("c", unit, large),), act, equation=said)
    return model, np.array([large * rng.choice([-1.0, 1.0])])
