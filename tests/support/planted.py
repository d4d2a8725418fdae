"""Short logs with planted effects, of which everything is known: the motion in closed form, the noise, the constants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from imutool.diagnosis.estimation.aligned_log import Pair, split
from imutool.diagnosis.estimation.jacobians import Chosen
from imutool.diagnosis.estimation.trial.effect_forms import in_forms
from imutool.diagnosis.estimation.whitening import WhitenedImu, Whitener
from imutool.inertial.kinematics import Trajectory
from imutool.recording import Imu, Poses, Recording
from imutool.sensor import catalogue as _catalogue
from imutool.sensor.effect import Acting, Effect, SignalState, in_stage_order
from imutool.sensor.made_up_flight import FlightSettings, trajectory
from imutool.sensor.samples import IdealMotion, SensorSamples, Times

RATE_HZ, DURATION_S = 100.0, 24.0
START_NS = 1_700_000_000_000_000_000
NOISE = np.array([0.003] * 3 + [0.03] * 3)  # of a sample: rad/s, m/s²
BIAS = np.array([0.02, -0.01, 0.015, 0.1, -0.2, 0.15])
SHOWN_BY_SAMPLES = ("saturation", "quantization")


def moving(seed: int = 1, duration_s: float = DURATION_S) -> Trajectory:
    """A flight that never rests."""
    return trajectory(seed, FlightSettings(duration_s=duration_s, rate_hz=RATE_HZ, still_s=0.0))


def clock(duration_s: float = DURATION_S, rate_hz: float = RATE_HZ, first_s: float = 0.0) -> np.ndarray:
    return first_s + np.arange(round((duration_s - first_s) * rate_hz)) / rate_hz


def rich(seed: int = 1, duration_s: float = DURATION_S, channels: Mapping[str, np.ndarray] | None = None) -> IdealMotion:
    """Turns about all three axes, tilts, and accelerates."""
    path, t_s = moving(seed, duration_s), clock(duration_s)
    motion = path.at(path.start_ns + np.round(t_s * 1e9).astype(np.int64))
    R_wb = Rotation.from_quat(motion.q_wb_wxyz, scalar_first=True).as_matrix()
    felt = IdealMotion(t_s, motion.omega_b, motion.specific_force(), motion.alpha_b, R_wb)
    return felt if channels is None else replace(felt, channels=channels)


def planar(duration_s: float = DURATION_S) -> IdealMotion:
    """A vehicle on level ground: turns about z alone, accelerates along x and y."""
    t = clock(duration_s)
    heading = 0.8 * np.sin(0.9 * t) + 0.5 * np.sin(2.1 * t + 1.0)
    rate = 0.72 * np.cos(0.9 * t) + 1.05 * np.cos(2.1 * t + 1.0)
    alpha = -0.648 * np.sin(0.9 * t) - 2.205 * np.sin(2.1 * t + 1.0)
    zero, up = np.zeros_like(t), np.full_like(t, 9.81)
    force = np.stack([0.7 * np.sin(1.3 * t), 0.5 * np.cos(0.7 * t), up], axis=1)
    R_wb = Rotation.from_euler("z", heading[:, None]).as_matrix()
    return IdealMotion(t, np.stack([zero, zero, rate], axis=1), force, np.stack([zero, zero, alpha], axis=1), R_wb)


def shaken(seed: int = 1, duration_s: float = DURATION_S) -> IdealMotion:
    """Turns to and fro about all three axes so often that every few seconds see every rate; angular rates in closed form."""
    rng, t = np.random.default_rng([seed, 3]), clock(duration_s)
    f, size, phase = rng.uniform(0.3, 1.5, (3, 4)), rng.uniform(0.2, 0.5, (3, 4)), rng.uniform(0.0, 2.0 * np.pi, (3, 4))
    angle = 2.0 * np.pi * f * t[:, None, None] + phase
    gyro = (size * np.cos(angle)).sum(axis=2)
    alpha = (-2.0 * np.pi * f * size * np.sin(angle)).sum(axis=2)
    R, R_wb = np.eye(3), np.empty((len(t), 3, 3))
    for k, step in enumerate(Rotation.from_rotvec((gyro + 0.5 * alpha / RATE_HZ) / RATE_HZ).as_matrix()):
        R_wb[k] = R
        R = R @ step
    a_w = np.stack([np.sin(1.7 * t + 2.0 * k) + 0.5 * np.cos(4.1 * t + k) for k in range(3)], axis=1)
    force = np.einsum("nji,nj->ni", R_wb, a_w + np.array([0.0, 0.0, 9.81]))
    return IdealMotion(t, gyro, force, alpha, R_wb)


def acting(effects: Mapping[str, Sequence[float]]) -> Chosen:
    """Effects of the catalogue by name, with their parameters; a low-pass without all is analog."""
    found = ((_catalogue.diagnosed([name])[0], np.array(theta, dtype=float)) for name, theta in effects.items())
    return tuple((one if len(theta) == len(one.parameters) else in_forms([one], exact=False)[0], theta) for one, theta in found)


def catalogue() -> tuple[Effect, ...]:
    """All that a fit can find against a simulation, without another channel of the log."""
    others = {*SHOWN_BY_SAMPLES, "clock_wander"}
    found = (one for one in _catalogue.diagnosed() if set(one.needs) <= {"attitude"} and one.name not in others)
    return tuple(in_forms(found, exact=True))


def simulate_samples(motion: IdealMotion, stamp_s: Times, acting: Acting) -> SensorSamples:
    """Samples of a sensor with these effects at some stamps, applied in stage order."""
    state = SignalState(motion, np.asarray(stamp_s, dtype=np.float64), stamp_s)
    for effect, theta in in_stage_order(acting):
        state = state.through(effect, theta)
    samples: SensorSamples = state.samples()
    return samples


def ideal(felt: IdealMotion, chosen: Chosen = (), stamp_s: np.ndarray | None = None) -> np.ndarray:
    """Readings with effects, without noise and bias: gyro (rad/s), accel (m/s²)."""
    got = simulate_samples(felt, felt.t_s if stamp_s is None else stamp_s, chosen)
    return np.concatenate([got.gyro, got.accel], axis=1)


def noise(count: int, seed: int) -> np.ndarray:
    return NOISE * np.random.default_rng([seed, 7]).normal(size=(count, 6))


def pair(
    felt: IdealMotion,
    effects: Mapping[str, Sequence[float]] | None = None,
    seed: int = 0,
    stamp_s: np.ndarray | None = None,
    bias: np.ndarray = BIAS,
    added: np.ndarray | None = None,
) -> Pair:
    """A recording of a motion with effects, white noise and a bias, next to the motion itself."""
    stamp_s = felt.t_s if stamp_s is None else stamp_s
    real = ideal(felt, acting(effects or {}), stamp_s) + noise(len(stamp_s), seed) + bias
    if added is not None:
        real = real + added
    held_out, usable = split(stamp_s)
    names = {name: np.interp(stamp_s, felt.t_s, values) for name, values in felt.channels.items()}
    return Pair(f"log_{seed}", stamp_s, real, usable & ~held_out, usable & held_out, ideal=felt, channels=names)


def weighed(one: Pair) -> WhitenedImu:
    """By the noise that was planted, which is white."""
    return WhitenedImu(one, Whitener(np.ones((6, 1)), NOISE))


def recording(
    name: str,
    t_s: np.ndarray,
    samples: np.ndarray,
    start_ns: int = START_NS,
    poses: Poses | None = None,
) -> Recording:
    """Samples by seconds from `start_ns`."""
    t_ns = start_ns + np.round(t_s * 1e9).astype(np.int64)
    truths = {} if poses is None else {"/ground_truth/pose": poses}
    return Recording(name, Imu(t_ns, samples[:, :3].copy(), samples[:, 3:].copy()), truths=truths)


def poses(path: Trajectory, t_s: np.ndarray, start_ns: int = START_NS) -> Poses:
    """True poses of a motion on another epoch."""
    exact = path.poses(path.start_ns + np.round(t_s * 1e9).astype(np.int64))
    return Poses(start_ns + np.round(t_s * 1e9).astype(np.int64), exact.p_wb, exact.q_wb_wxyz)
