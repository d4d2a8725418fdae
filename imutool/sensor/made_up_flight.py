"""Synthetic flights: an exact motion, and a low-cost IMU with bias, scale and misalignment."""

from __future__ import annotations

import zlib
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta
from numpy.random import Generator, default_rng
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from imutool import config
from imutool.array_types import Float64, Vectors
from imutool.errors import ConfigError
from imutool.inertial.kinematics import DEGREE, Trajectory, continuous
from imutool.recording import Imu, Poses, Recording, Scalars, Times, seconds

EPOCH_NS = 1_700_000_000_000_000_000  # a real epoch, so that a lost last digit of a stamp shows
SPACING_NS = 3_600_000_000_000  # flights of neighbouring seeds start an hour apart
SEEDS_APART = 100_000  # after eleven years the starts begin again, so that no seed overflows the clock
MARGIN_S = 0.1  # the trajectory exists a little before and after the flight, the truth a part of that
TRUTH_PHASE_S = 0.0031  # the first true pose comes this much before the first IMU sample: two clocks, not one
PERSISTENCE = 0.7  # how much of its departure from the mean a control point keeps at the next
GYRO_BIAS, ACCEL_BIAS = "/ground_truth/bias/gyro", "/ground_truth/bias/accel"

NotNegative = Annotated[float, Meta(ge=0.0)]
Positive = Annotated[float, Meta(gt=0.0)]


class TriadSettings(config.Settings, frozen=True, kw_only=True):
    """Noise and errors of one triad in its unit u: rad/s (gyroscope), m/s² (accelerometer).

    Noise densities are a data sheet's; the other entries are standard deviations from which a sensor, or one flight
    of that sensor, is drawn.
    """

    noise_density: NotNegative  # u/sqrt(Hz)
    walk_density: NotNegative  # u/s/sqrt(Hz), the bias's random walk
    typical_bias: NotNegative  # u, per axis, drawn once per sensor
    turn_on_bias: NotNegative  # u, per axis, drawn anew each flight, around the sensor's typical bias
    warm_up: NotNegative  # u, per axis, drawn once per sensor; gone after a few time constants
    scale: NotNegative  # drawn once per sensor
    misalignment_rad: NotNegative  # drawn once per sensor


# Densities of the ADIS16448 as EuRoC's sensor.yaml states them; the rest of the size its recordings show.
GYRO = TriadSettings(
    noise_density=1.6968e-4,
    walk_density=1.9393e-5,
    typical_bias=0.04,
    turn_on_bias=0.002,
    warm_up=0.004,
    scale=0.008,
    misalignment_rad=0.006,
)
ACCEL = TriadSettings(
    noise_density=2.0e-3,
    walk_density=3.0e-3,
    typical_bias=0.12,
    turn_on_bias=0.01,
    warm_up=0.02,
    scale=0.005,
    misalignment_rad=0.004,
)


class FlightSettings(config.Settings, frozen=True, kw_only=True):
    """Settings of a synthetic flight: motion, sampling, sensor and quality of the truth."""

    duration_s: Positive = 60.0
    rate_hz: Positive = 200.0
    still_s: NotNegative = 3.0
    sensor_seed: Annotated[int, Meta(ge=0)] = 0
    warm_up_s: Positive = 20.0
    gyro: TriadSettings = GYRO
    accel: TriadSettings = ACCEL
    truth_rate_hz: Positive = 120.0
    truth_noise_m: NotNegative = 1e-4
    truth_noise_rad: NotNegative = 1e-4
    room_m: NotNegative = 3.0  # standard deviation of the horizontal position, mean height; half of it vertically
    position_knot_s: Positive = 0.6
    tilt_rad: NotNegative = 0.5  # standard deviation of roll and pitch
    turn_rad: NotNegative = 0.5  # standard deviation of the change of heading from knot to knot
    attitude_knot_s: Positive = 0.35


def flight(seed: int = 0, settings: FlightSettings | None = None, **changes: Any) -> Recording:
    """Synthetic flight of sensor `sensor_seed`: raw IMU, true poses with velocity and biases.

    accel, gyro = M s + b(t) + noise, with s from the kinematics of the trajectory, M = I + scale + misalignment fixed
    for the sensor, b = turn-on value + warm-up exp(-t / warm_up_s) + random walk. The true bias on
    `/ground_truth/bias/gyro` (rad/s) and `.../accel` (m/s²) is that b alone, at every IMU stamp. Motion, turn-on value
    and noise change with `seed`; typical bias, warm-up and M only with `sensor_seed`. The same arguments give the same
    bits, and a shorter flight is the beginning of a longer one. `changes` are fields laid over `settings`.

    Raises:
        ConfigError: an unknown field (the nearest is named) or a value out of range.
    """
    given = config.plain(settings or FlightSettings()) | {k: msgspec.to_builtins(v) for k, v in changes.items()}
    chosen = config.build(FlightSettings, given, where="flight")
    path = trajectory(seed, chosen)
    t_ns = _clock(path.start_ns, chosen.duration_s, chosen.rate_hz)
    ideal = path.imu(t_ns)
    gyro, gyro_bias = _measure(ideal.gyro, t_ns, chosen.gyro, chosen, seed, "gyro")
    accel, accel_bias = _measure(ideal.accel, t_ns, chosen.accel, chosen, seed, "accel")
    return Recording(
        name=f"flight_{seed}",
        imu=Imu(t_ns, gyro, accel),
        truths={"/ground_truth/pose": _truth(path, chosen, seed)},
        scalars={GYRO_BIAS: Scalars(t_ns, gyro_bias, "rad/s"), ACCEL_BIAS: Scalars(t_ns, accel_bias, "m/s^2")},
        metadata={
            "source": {"dataset": "flight", "seed": str(seed), "settings": msgspec.json.encode(chosen).decode()},
        },
        source=f"imutool flight {seed}",
    )


def trajectory(seed: int = 0, settings: FlightSettings | None = None) -> Trajectory:
    """Exact motion of a flight, from a tenth of a second before it to a tenth after.

    Uniform quintic B-splines on random control points: their support is local, so equal control points at the start
    make an exactly motionless start, which a spline forced through points would ring into.

    Raises:
        ConfigError: a negative seed.
    """
    chosen = settings or FlightSettings()
    still, free = _points(chosen, chosen.position_knot_s)
    position = _wander(
        _generator("position", seed),
        free,
        np.array([1.0, 1.0, 0.5]) * chosen.room_m,
        np.array([0.0, 0.0, chosen.room_m]),
    )
    start_ns = EPOCH_NS + (seed % SEEDS_APART) * SPACING_NS
    position_spline = _spline(position, still, chosen.position_knot_s)
    still, free = _points(chosen, chosen.attitude_knot_s)
    tilt = _wander(_generator("tilt", seed), free, np.full(2, chosen.tilt_rad), np.zeros(2))
    rng = _generator("heading", seed)
    heading = rng.uniform(-np.pi, np.pi) + np.cumsum(rng.normal(0.0, chosen.turn_rad, free))
    attitude = Rotation.from_euler("ZYX", np.column_stack([heading, tilt])).as_quat(scalar_first=True)
    return Trajectory(start_ns, position_spline, _spline(continuous(attitude), still, chosen.attitude_knot_s))


def _points(settings: FlightSettings, knot_s: float) -> tuple[int, int]:
    """Number of control points that repeat the first (rest until `still_s`), and of free ones.

    Point j acts from knot j on, and knot j lies at (j - DEGREE) knot_s - MARGIN_S.
    """
    total = int(np.ceil((settings.duration_s + 2.0 * MARGIN_S) / knot_s)) + DEGREE
    still = int(np.ceil((settings.still_s + MARGIN_S) / knot_s)) + DEGREE
    return min(still, total), max(total - still, 1)


def _spline(points: Float64[np.ndarray, "free k"], still: int, knot_s: float) -> BSpline:
    """Uniform B-spline on `still` copies of the first control point, then the control points."""
    coefficients = np.concatenate([np.repeat(points[:1], still, axis=0), points])
    knots = (np.arange(len(coefficients) + DEGREE + 1) - DEGREE) * knot_s - MARGIN_S
    spline: BSpline = BSpline(knots, coefficients, DEGREE)
    return spline


def _wander(
    rng: Generator, count: int, size: Float64[np.ndarray, " k"], centre: Float64[np.ndarray, " k"]
) -> Float64[np.ndarray, "count k"]:
    """First-order autoregression about a centre, of standard deviation `size`, from near zero."""
    steps = np.sqrt(1.0 - PERSISTENCE**2) * size * rng.normal(size=(count, len(size)))
    path: Float64[np.ndarray, "count k"] = np.zeros_like(steps)
    for row in range(1, count):  # one row per control point: hundreds, not samples
        path[row] = centre + PERSISTENCE * (path[row - 1] - centre) + steps[row]
    return path


def _measure(
    ideal: Vectors, t_ns: Times, triad: TriadSettings, settings: FlightSettings, seed: int, name: str
) -> tuple[Vectors, Vectors]:
    """Readings of the triad, and its additive bias."""
    sensor, turn_on, walk, noise = (
        _generator(f"{name} sensor", settings.sensor_seed),
        *(_generator(f"{name} {kind}", seed) for kind in ("turn-on", "walk", "noise")),
    )
    typical = triad.typical_bias * sensor.normal(size=3)
    warm_up = triad.warm_up * sensor.normal(size=3)
    off_axis = triad.misalignment_rad * sensor.normal(size=(3, 3))
    np.fill_diagonal(off_axis, 0.0)
    M: Float64[np.ndarray, "3 3"] = np.eye(3) + np.diag(triad.scale * sensor.normal(size=3)) + off_axis

    t = seconds(t_ns, int(t_ns[0]))
    steps = triad.walk_density * np.sqrt(np.diff(t, prepend=0.0))[:, None] * walk.normal(size=(len(t), 3))
    start = typical + triad.turn_on_bias * turn_on.normal(size=3)
    bias = start + np.exp(-t / settings.warm_up_s)[:, None] * warm_up + np.cumsum(steps, axis=0)
    white = triad.noise_density * np.sqrt(settings.rate_hz) * noise.normal(size=(len(t), 3))
    return ideal @ M.T + bias + white, bias


def _truth(path: Trajectory, settings: FlightSettings, seed: int) -> Poses:
    """True poses on their own clock, with a motion capture's small noise; the velocity is exact."""
    position_noise, turn_noise = _generator("truth position", seed), _generator("truth turn", seed)
    first = path.start_ns - round(TRUTH_PHASE_S * 1e9)
    exact = path.poses(_clock(first, settings.duration_s + TRUTH_PHASE_S + MARGIN_S / 2, settings.truth_rate_hz))
    n = len(exact)
    shaken = Rotation.from_quat(exact.q_wb_wxyz, scalar_first=True) * Rotation.from_rotvec(
        settings.truth_noise_rad * turn_noise.normal(size=(n, 3))
    )
    q_wb_wxyz = np.ascontiguousarray(continuous(shaken.as_quat(scalar_first=True)))
    p_wb = exact.p_wb + settings.truth_noise_m * position_noise.normal(size=(n, 3))
    return Poses(exact.t_ns, p_wb, q_wb_wxyz, exact.v_w)


def _clock(start_ns: int, duration_s: float, rate_hz: float) -> Times:
    """Stamps of a regular clock within the duration, each rounded by itself."""
    count = int(np.floor(duration_s * rate_hz + 1e-6)) + 1
    return start_ns + np.round(np.arange(count) * (1e9 / rate_hz)).astype(np.int64)


def _generator(purpose: str, seed: int) -> Generator:
    """Random numbers by purpose, so that a new purpose does not change those of the others."""
    if seed < 0:
        raise ConfigError(f"seed {seed} is negative", where="flight", expected="0 or more")
    return default_rng([zlib.crc32(purpose.encode()), seed])
