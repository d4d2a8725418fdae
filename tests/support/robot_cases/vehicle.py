"""Vehicles for blind cases: one on two wheels, and one that flies with four sensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.signal import lfilter

RATE_HZ, DURATION_S, FINE = 100.0, 40.0, 10
RADIUS_M, TRACK_M = 0.1, 0.5
FIELD_T = np.array([22e-6, 2e-6, -42e-6])  # east is y, down is -z
GROUND_PA, PASCALS_A_METRE = 101_325.0, -12.0
Topics = dict[str, tuple[str, Float64[np.ndarray, " _"], Float64[np.ndarray, "_ _"]]]


@dataclass(frozen=True)
class OnWheels:
    """Changes of the real wheels (share), of the track (share), and slip (s²/m)."""

    radius: tuple[float, float] = (0.0, 0.0)
    track: float = 0.0
    slip: float = 0.0


@dataclass(frozen=True)
class InFlight:
    """What the real sensors have and the simulated ones lack (T, rad, s, Pa/K, m)."""

    hard: tuple[float, float, float] = (0.0, 0.0, 0.0)
    soft: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    turned: tuple[float, float, float] = (0.0, 0.0, 0.0)
    declination: float = 0.0
    lag_s: float = 0.0
    dynamic: float = 0.0
    per_kelvin: float = 0.0
    arm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    latency_s: float = 0.0
    range_gain: float = 1.0
    range_offset: float = 0.0


def smooth(rng: np.random.Generator, t_s: Float64[np.ndarray, " n"], max_hz: float, size: float) -> Float64[np.ndarray, " n"]:
    """A sum of eight sines of a standard deviation."""
    w = 2.0 * np.pi * rng.uniform(0.04, max_hz, 8)
    out = (rng.uniform(0.5, 1.0, 8)[:, None] * np.sin(np.outer(w, t_s) + rng.uniform(0.0, 6.3, 8)[:, None])).sum(axis=0)
    return np.asarray(size * out / out.std())


def driven(left_out: OnWheels, course: np.random.Generator, noise: np.random.Generator) -> Topics:
    """Wheel speeds and the motion that they make."""
    t = np.arange(round(DURATION_S * RATE_HZ)) / RATE_HZ
    speed, turn = 0.6 + smooth(course, t, 0.6, 0.5), smooth(course, t, 0.5, 0.6)
    wheels = np.stack([(speed - 0.5 * TRACK_M * turn) / RADIUS_M, (speed + 0.5 * TRACK_M * turn) / RADIUS_M], axis=1)
    left, right = (RADIUS_M * (1.0 + change) * w for change, w in zip(left_out.radius, wheels.T, strict=True))
    v, w = 0.5 * (left + right), (right - left) / (TRACK_M * (1.0 + left_out.track))
    v = v - left_out.slip * np.gradient(v, t) * np.abs(v)
    n = len(t)
    wheels = wheels + 0.01 * noise.normal(size=wheels.shape)
    joints = np.concatenate([np.cumsum(wheels, axis=0) / RATE_HZ, wheels], axis=1)
    odometry = np.zeros((n, 13))
    odometry[:, 6] = 1.0
    odometry[:, 7] = v + 0.005 * noise.normal(size=n)
    odometry[:, 12] = w + 0.005 * noise.normal(size=n)
    return {
        "/joint_states": ("sensor_msgs/msg/JointState", t, joints),
        "/odom": ("nav_msgs/msg/Odometry", t, odometry),
    }


def _rotation(angles: Mapping[str, Float64[np.ndarray, " n"]]) -> Float64[np.ndarray, "n 3 3"]:
    """Body to world, by yaw, pitch and roll."""
    (cy, sy), (cp, sp), (cr, sr) = ((np.cos(angles[k]), np.sin(angles[k])) for k in ("yaw", "pitch", "roll"))
    rows = [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, sy * cp, sy * sp * sr + cy * cr]
    rows += [sy * sp * cr - cy * sr, -sp, cp * sr, cp * cr]
    return np.asarray(np.stack(rows, axis=1).reshape(-1, 3, 3))


def _quaternion(angles: Mapping[str, Float64[np.ndarray, " n"]]) -> Float64[np.ndarray, "n 4"]:
    """x, y, z, w of the same."""
    (cy, sy), (cp, sp), (cr, sr) = ((np.cos(0.5 * angles[k]), np.sin(0.5 * angles[k])) for k in ("yaw", "pitch", "roll"))
    x, y = sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy
    return np.stack([x, y, cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy], axis=1)


def _turn(v: tuple[float, float, float]) -> Float64[np.ndarray, "3 3"]:
    """Rotation by a rotation vector (Rodrigues)."""
    angle = float(np.linalg.norm(v))
    if not angle:
        return np.eye(3)
    x, y, z = np.array(v) / angle
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K)


def flown(own: InFlight, course: np.random.Generator, noise: np.random.Generator) -> Topics:
    """Attitude, field, pressure, temperature, position and height of a flight."""
    fine = np.arange(round((DURATION_S + 2.0) * RATE_HZ * FINE)) / (RATE_HZ * FINE)
    angles = {
        "yaw": smooth(course, fine, 0.3, 0.9),
        "pitch": smooth(course, fine, 0.5, 0.35),
        "roll": smooth(course, fine, 0.5, 0.35),
    }
    p = np.stack([smooth(course, fine, 0.25, size) for size in (8.0, 8.0, 2.0)], axis=1) + np.array([0.0, 0.0, 8.0])
    v = np.gradient(p, fine, axis=0)
    kelvin = 300.0 + 8.0 * np.cumsum(smooth(course, fine, 0.1, 1.0)) / len(fine) * 4.0
    R = _rotation(angles)
    S = np.eye(3)
    for value, (i, j) in zip(own.soft, ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)), strict=True):
        S[i, j] += value
        S[j, i] = S[i, j]
    earth = _turn((0.0, 0.0, own.declination)) @ FIELD_T
    field = np.einsum("nji,j->ni", R, earth) @ _turn(own.turned) @ S + np.array(own.hard)
    air = GROUND_PA + PASCALS_A_METRE * p[:, 2] + own.dynamic * 0.5 * 1.225 * (v**2).sum(axis=1)
    if own.lag_s:
        share = 1.0 - np.exp(-1.0 / (RATE_HZ * FINE * own.lag_s))
        air = lfilter([share], [1.0, share - 1.0], air - air[0]) + air[0]
    air = air + own.per_kelvin * (kelvin - 300.0)
    antenna = p + np.einsum("nij,j->ni", R, np.array(own.arm))
    height = own.range_gain * p[:, 2] + own.range_offset
    at = np.arange(round(RATE_HZ), len(fine) // FINE) * FINE
    late = at - round(own.latency_s * RATE_HZ * FINE)
    t, n = fine[at], len(at)
    degrees = antenna[late] * np.array([1.0 / 78_847.0, 1.0 / 111_132.0, 1.0])
    body_v = np.einsum("nji,nj->ni", R[at], v[at])
    odometry = np.concatenate([p[at], _quaternion(angles)[at], body_v, np.zeros((n, 3))], axis=1)
    slow, fix = slice(0, None, 2), slice(0, None, 5)
    place = np.array([8.0, 45.0, 400.0]) + degrees + noise.normal(size=(n, 3)) * np.array([2e-7, 2e-7, 0.02])
    return {
        "/odom": ("nav_msgs/msg/Odometry", t, odometry),
        "/mag": ("sensor_msgs/msg/MagneticField", t[slow], (field[at] + 1e-7 * noise.normal(size=(n, 3)))[slow]),
        "/baro": ("sensor_msgs/msg/FluidPressure", t[slow], (air[at] + 1.0 * noise.normal(size=n))[slow, None]),
        "/temperature": ("sensor_msgs/msg/Temperature", t[slow], kelvin[at][slow, None]),
        "/gnss": ("sensor_msgs/msg/NavSatFix", t[fix], place[fix][:, [1, 0, 2]]),
        "/range": ("sensor_msgs/msg/Range", t[slow], (height[at] + 0.01 * noise.normal(size=n))[slow, None]),
    }
