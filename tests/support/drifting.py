"""Logs of made-up sensors whose gyro bias really evolves: it warms up, follows a temperature or the load of the motion.

The motion comes and goes: the clock of a made-up flight runs fast and slow, so that no load is constant. Every log is a
switching-on of its own.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float64
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from imutool.config import Settings
from imutool.inertial.kinematics import G_W
from imutool.recording import Imu, Poses, Recording, Scalars
from imutool.sensor.made_up_flight import EPOCH_NS, FlightSettings, trajectory

Kind = Literal["none", "warm_up", "self_heating", "ambient", "rate", "vibration", "force"]
KINDS: tuple[Kind, ...] = ("warm_up", "self_heating", "ambient", "rate", "vibration", "force")
DAY_NS = 86_400_000_000_000
REST_S, MARGIN_S = 5.0, 0.05
TEMPERATURE = "/imu0/temperature"


class Drifting(Settings, frozen=True, kw_only=True):
    """One sensor whose bias drifts by `size_rad_s` with a lag of `lag_s`."""

    kind: Kind
    sensor_seed: int = 0
    size_rad_s: float = 0.015
    lag_s: float = 25.0
    turn_on_rad_s: float = 0.002
    turn_on_m_s2: float = 0.02
    scale: float = 0.005
    noise_rad_s_rthz: float = 2e-4
    noise_m_s2_rthz: float = 2e-3
    walk_rad_s2_rthz: float = 1e-5
    truth_noise: float = 1e-3  # rad and m of a pose
    rate_hz: float = 100.0


def log(seed: int, sensor: Drifting, duration_s: float = 90.0) -> Recording:
    """Log `seed` of a sensor, with true poses and, where it follows one, its temperature."""
    rng, made = np.random.default_rng([seed, 1]), np.random.default_rng([sensor.sensor_seed, 2])
    t_s = np.arange(round(duration_s * sensor.rate_hz)) / sensor.rate_hz
    flight = FlightSettings(duration_s=2.0 * duration_s, still_s=1.0, turn_rad=1.0, attitude_knot_s=1.0, position_knot_s=1.5)
    path = trajectory(seed, flight)
    place_s, speed, change = _activity(t_s, rng)
    motion = path.at(path.start_ns + np.round(1e9 * place_s).astype(np.int64))
    R_wb = Rotation.from_quat(motion.q_wb_wxyz, scalar_first=True)
    omega = motion.omega_b * speed[:, None]
    a_w = motion.a_w * speed[:, None] ** 2 + motion.v_w * change[:, None]
    force = R_wb.apply(a_w - G_W, inverse=True)
    shaking = 4.0 * np.clip(np.sin(2 * np.pi * t_s / rng.uniform(40.0, 70.0) + rng.uniform(0.0, 2 * np.pi)), 0.0, 1.0)
    shaking *= sensor.kind == "vibration"
    force = force + shaking[:, None] * rng.normal(size=force.shape) * (t_s > REST_S)[:, None]
    temperature = _temperature(t_s, sensor, rng)
    axes = made.uniform(0.6, 1.6, size=3) * made.choice([-1.0, 1.0], size=3)
    drift = sensor.size_rad_s * _level(t_s, omega, force, shaking, temperature, sensor, rng)[:, None] * axes
    white = np.sqrt(sensor.rate_hz) * rng.normal(size=(len(t_s), 6))
    walk = sensor.walk_rad_s2_rthz / np.sqrt(sensor.rate_hz) * np.cumsum(rng.normal(size=omega.shape), axis=0)
    M = np.eye(3) + sensor.scale * made.normal(size=(2, 3, 3))
    gyro = omega @ M[0].T + sensor.turn_on_rad_s * rng.normal(size=3) + walk + drift + sensor.noise_rad_s_rthz * white[:, :3]
    accel = force @ M[1].T + sensor.turn_on_m_s2 * rng.normal(size=3) + sensor.noise_m_s2_rthz * white[:, 3:]
    t_ns = EPOCH_NS + DAY_NS * seed + np.round(1e9 * t_s).astype(np.int64)
    turned = R_wb * Rotation.from_rotvec(sensor.truth_noise * rng.normal(size=omega.shape))
    p_wb = motion.p_wb + sensor.truth_noise * rng.normal(size=omega.shape)
    poses = Poses(t_ns, p_wb, np.ascontiguousarray(turned.as_quat(scalar_first=True)), motion.v_w * speed[:, None])
    channels = {TEMPERATURE: Scalars(t_ns, temperature[:, None], "degC")} if sensor.kind == "ambient" else {}
    return Recording(f"{sensor.kind}_{seed}", Imu(t_ns, gyro, accel), {"/ground_truth/pose": poses}, scalars=channels)


def _activity(t_s: Float64[np.ndarray, " n"], rng: np.random.Generator) -> tuple[Float64[np.ndarray, " n"], ...]:
    """Time on the flight's clock, its speed and the change of that; at first it stands still."""
    w, phase, swing = 2 * np.pi / rng.uniform(30.0, 60.0), rng.uniform(0.0, 2 * np.pi), rng.uniform(0.4, 0.8)
    on = np.clip((t_s - REST_S) / 2.0, 0.0, 1.0)
    begin, slope = 3 * on**2 - 2 * on**3, np.where((on > 0.0) & (on < 1.0), 3.0 * (on - on**2), 0.0)
    full = 0.9 + swing * np.sin(w * t_s + phase)
    speed = begin * full
    change = slope * full + begin * swing * w * np.cos(w * t_s + phase)
    step = np.diff(t_s, prepend=t_s[0])
    place = np.cumsum(0.5 * (speed + np.concatenate([speed[:1], speed[:-1]])) * step)
    return 1.0 + place, speed, change


def _temperature(t_s: Float64[np.ndarray, " n"], sensor: Drifting, rng: np.random.Generator) -> Float64[np.ndarray, " n"]:
    """Temperature: of what a sensor heats by itself, the same in each log, or of surroundings that step at any time."""
    if sensor.kind == "ambient":
        times, steps = rng.uniform(0.0, t_s[-1], size=3 + int(t_s[-1] / 40.0)), rng.normal(size=3 + int(t_s[-1] / 40.0))
        outside = (steps * (t_s[:, None] > times)).sum(axis=1)
        return 25.0 + 10.0 * _lagged(outside, sensor)
    return 25.0 + 12.0 * -np.expm1(-t_s / sensor.lag_s)


def _level(
    t_s: Float64[np.ndarray, " n"],
    omega: Float64[np.ndarray, "n 3"],
    force: Float64[np.ndarray, "n 3"],
    shaking: Float64[np.ndarray, " n"],
    temperature: Float64[np.ndarray, " n"],
    sensor: Drifting,
    rng: np.random.Generator,
) -> Float64[np.ndarray, " n"]:
    """Drift in units of its size."""
    if sensor.kind == "warm_up":
        return np.asarray((1.0 + 0.05 * rng.normal()) * np.exp(-t_s / sensor.lag_s))
    if sensor.kind in ("self_heating", "ambient"):
        warmer = (temperature - 25.0) / 12.0
        return np.asarray(0.6 * warmer + 0.4 * warmer**2)
    square = (omega**2).sum(axis=1)
    loads = {
        "none": np.zeros(len(t_s)),
        "rate": square / (square + 0.5),
        "vibration": shaking**2 / (shaking**2 + 3.0),
        "force": np.tanh(np.abs(np.linalg.norm(force, axis=1) - 9.81) / 2.0),
    }
    return _lagged(loads[sensor.kind], sensor)


def _lagged(x: Float64[np.ndarray, " n"], sensor: Drifting) -> Float64[np.ndarray, " n"]:
    """Response dy/dt = (x - y) / lag, from zero."""
    keep = np.exp(-1.0 / (sensor.rate_hz * sensor.lag_s))
    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], x))
