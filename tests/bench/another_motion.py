"""Right simulations of another motion: pairs of logs of one sensor on nine kinds of bodies, and what `diagnose` says of them.

`python tests/bench/another_motion.py --pairs 27 --seed 1 [--planted]`. The generator shares no code with the diagnosis: angles
and positions are sums of sines, impacts and moves, of which a sensor reads finite differences. Nothing is planted, or one
effect, which has to be the only finding.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from numpy.random import Generator, default_rng
from scipy.signal import butter, lfilter
from scipy.spatial.transform import Rotation

from imutool.diagnosis.diagnose import diagnose
from imutool.errors import ImutoolError
from imutool.mcap_io.write import write
from imutool.recording import Imu, Poses, Recording

H_S = 2e-4  # of central differences of fourth order
FILTERED_HZ = 2000.0  # at which a filter runs before its sensor samples
G_W = np.array([0.0, 0.0, -9.81])
Times = Float64[np.ndarray, " n"]
Vectors = Float64[np.ndarray, "n 3"]
Curve = Callable[[Times], Times]


class Motion(NamedTuple):
    """Yaw, pitch, roll in rad, and position in m."""

    angles: tuple[Curve, ...]
    position: tuple[Curve, ...]


class Device(NamedTuple):
    """White noise of gyro and accelerometer per root of a hertz, biases, and steps of their registers."""

    density: tuple[float, float]
    bias: tuple[float, float]
    lsb: tuple[float, float]


DEVICES = (
    Device((1.5e-4, 1.5e-3), (5e-3, 0.05), (6.25e-5, 6.0e-4)),
    Device((3e-5, 4e-4), (1e-3, 0.02), (2e-5, 1e-4)),
    Device((4e-4, 3e-3), (2e-2, 0.15), (1.06e-3, 2.4e-3)),
    Device((8e-5, 8e-4), (3e-3, 0.05), (0.0, 0.0)),
)


@dataclass(frozen=True)
class Rig:
    """How a body is recorded."""

    duration_s: float
    imu_hz: float
    pose_hz: float
    pose_std: tuple[float, float]  # m, rad
    device: Device
    filter_hz: float | None  # Butterworth of second order, of gyro and accelerometer alike


# ── motions ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def sines(rng: Generator, slowest_hz: float, fastest_hz: float, count: int, size: float) -> Curve:
    """Sines of random frequencies, weaker where they are faster; `size` is the RMS of their sum."""
    f_hz = np.exp(rng.uniform(np.log(slowest_hz), np.log(fastest_hz), count))
    phase, a = rng.uniform(0.0, 2.0 * np.pi, count), rng.normal(size=count) / (1.0 + f_hz / slowest_hz)
    a *= size / np.sqrt(0.5 * a @ a)
    return lambda t: np.asarray(np.sin(2.0 * np.pi * np.outer(t, f_hz) + phase) @ a)


def steps(rng: Generator, rate_hz: float, wander: float) -> Curve:
    """Phase of a gait."""
    wanders = sines(rng, 0.05, 0.5, 6, wander)
    return lambda t: 2.0 * np.pi * (rate_hz * t + wanders(t))


def harmonic(rng: Generator, beat: Curve, multiple: float, size: float) -> Curve:
    """One harmonic of a gait."""
    begins = rng.uniform(0.0, 2.0 * np.pi)
    return lambda t: size * np.cos(multiple * beat(t) + begins)


def impacts(rng: Generator, times_s: Times, width_s: float, size: float) -> Curve:
    """A short swing at each time."""
    sizes, widths_s = size * rng.lognormal(0.0, 0.3, len(times_s)), width_s * rng.uniform(0.8, 1.3, len(times_s))

    def curve(t: Times) -> Times:
        out = np.zeros_like(t)
        for at_s, a, w in zip(times_s, sizes, widths_s, strict=True):
            near = slice(*np.searchsorted(t, [at_s - 8.0 * w, at_s + 8.0 * w]))
            u = (t[near] - at_s) / w
            out[near] += a * np.exp(-0.5 * u**2) * np.cos(1.5 * u)
        return out

    return curve


def moves(rng: Generator, duration_s: float, size: float) -> Curve:
    """Rests, and smooth moves between them."""
    count = round(duration_s / 1.5)
    times_s, lengths_s, sizes = rng.uniform(1.0, duration_s, count), rng.uniform(0.4, 1.2, count), rng.normal(size=count)

    def curve(t: Times) -> Times:
        u = np.clip((t[:, None] - times_s) / lengths_s, 0.0, 1.0)
        return np.asarray((u**4 * (35.0 - 84.0 * u + 70.0 * u**2 - 20.0 * u**3)) @ (size * sizes))

    return curve


def added(*curves: Curve) -> Curve:
    """Their sum."""
    return lambda t: np.sum([curve(t) for curve in curves], axis=0)


class Channel(NamedTuple):
    """One of yaw, pitch, roll (rad), x, y, z (m) of a body: sines, harmonics of its gait, and what an impact does."""

    slowest_hz: float
    fastest_hz: float
    count: int
    rms: float
    harmonics: tuple[tuple[float, float], ...] = ()  # multiple of the gait's rate, and size
    impact: tuple[float, float] = (0.0, 0.0)  # width in s, and size


BODIES: dict[str, tuple[Channel, ...]] = {
    "boat": (
        Channel(0.01, 0.12, 8, 0.6), Channel(0.08, 0.35, 14, 0.07), Channel(0.1, 0.5, 14, 0.12),
        Channel(0.01, 0.3, 10, 3.0), Channel(0.01, 0.3, 10, 2.0), Channel(0.08, 0.4, 14, 0.45),
    ),
    "underwater": (
        Channel(0.01, 0.15, 8, 0.9), Channel(0.01, 0.2, 8, 0.12), Channel(0.02, 0.3, 8, 0.06),
        Channel(0.01, 0.15, 8, 2.0), Channel(0.01, 0.15, 8, 1.5), Channel(0.01, 0.15, 8, 0.8),
    ),
    "quadrotor": (
        Channel(0.05, 0.8, 10, 1.0), Channel(0.1, 2.5, 18, 0.2), Channel(0.1, 2.5, 18, 0.2),
        Channel(0.05, 0.8, 14, 1.2), Channel(0.05, 0.8, 14, 1.2), Channel(0.05, 0.9, 14, 0.5),
    ),
    "car": (
        Channel(0.01, 0.25, 10, 1.2), Channel(0.1, 2.5, 14, 0.012), Channel(0.1, 2.5, 14, 0.02),
        Channel(0.01, 0.1, 8, 40.0), Channel(0.01, 0.1, 8, 40.0), Channel(0.3, 8.0, 20, 0.01),
    ),
    "handheld": (
        Channel(0.1, 2.0, 16, 0.7), Channel(0.1, 3.0, 16, 0.4), Channel(0.1, 3.0, 16, 0.4),
        Channel(0.1, 2.5, 16, 0.3), Channel(0.1, 2.5, 16, 0.3), Channel(0.1, 2.5, 16, 0.2),
    ),
    "train": (
        Channel(0.005, 0.08, 6, 0.5), Channel(0.01, 1.2, 10, 0.006), Channel(0.2, 1.8, 12, 0.012),
        Channel(0.005, 0.05, 5, 150.0), Channel(0.005, 0.05, 5, 150.0), Channel(0.5, 6.0, 16, 0.004),
    ),
    "quadruped": (
        Channel(0.02, 0.25, 8, 0.8, ((1, 0.02),), (9e-3, 1e-3)),
        Channel(0.05, 0.6, 6, 0.04, ((2, 0.02), (1, 0.008)), (9e-3, 2e-3)),
        Channel(0.05, 0.6, 6, 0.03, ((1, 0.03), (3, 0.006)), (9e-3, 3e-3)),
        Channel(0.02, 0.3, 8, 1.5, ((2, 0.006),), (8e-3, 1.2e-4)),
        Channel(0.02, 0.3, 8, 1.0, ((1, 0.008),), (8e-3, 1.2e-4)),
        Channel(0.05, 0.3, 5, 0.02, ((2, 0.012), (4, 0.002)), (8e-3, 4e-4)),
    ),
    "head": (
        Channel(0.05, 1.2, 14, 0.6, ((0.5, 0.02),)),
        Channel(0.05, 1.5, 12, 0.15, ((1, 0.015),)),
        Channel(0.05, 1.5, 12, 0.08, ((0.5, 0.015),)),
        Channel(0.02, 0.3, 8, 2.0, ((1, 0.01),)),
        Channel(0.02, 0.3, 8, 2.0, ((0.5, 0.02),)),
        Channel(0.05, 0.5, 6, 0.03, ((1, 0.025), (2, 0.004))),
    ),
}  # fmt: skip
GAITS = {"quadruped": (1.6, 2.6, 0.06), "head": (1.6, 2.1, 0.1)}  # slowest and fastest rate (Hz), and how far its phase wanders
MOVES = (0.5, 0.3, 0.4, 0.2, 0.2, 0.15)  # size of an arm's, in the channels
KINDS = (*BODIES, "arm")
FILTERS_HZ = {"boat": (5.0, 10.0, 20.0), "underwater": (20.0, 40.0, 80.0)}  # of these bodies always, of others at times


def motion(kind: str, rng: Generator, duration_s: float) -> Motion:
    """A motion of a kind of body."""
    if kind == "arm":
        curves = [moves(rng, duration_s, size) for size in MOVES]
        return Motion(tuple(curves[:3]), tuple(curves[3:]))
    beat: Curve = np.zeros_like  # without a gait
    strikes_s = np.zeros(0)
    if kind in GAITS:
        slowest_hz, fastest_hz, wander = GAITS[kind]
        beat = steps(rng, rate_hz := rng.uniform(slowest_hz, fastest_hz), wander)
        if any(channel.impact[1] for channel in BODIES[kind]):
            ticks, t = np.arange(1, int(2.0 * rate_hz * duration_s) - 2), np.arange(0.0, duration_s, 1e-3)
            strikes_s = np.interp(ticks + rng.normal(0.0, 0.01, len(ticks)), beat(t) / np.pi, t)
    curves = []
    for channel in BODIES[kind]:
        parts = [sines(rng, channel.slowest_hz, channel.fastest_hz, channel.count, channel.rms)]
        parts += [harmonic(rng, beat, multiple, size) for multiple, size in channel.harmonics]
        parts.append(impacts(rng, strikes_s, *channel.impact))
        curves.append(added(*parts))
    return Motion(tuple(curves[:3]), tuple(curves[3:]))


# ── readings ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def readings(moving: Motion, t: Times) -> tuple[Vectors, Vectors]:
    """Rate and specific force in the body."""
    angles, places = (
        [np.stack([curve(t + k * H_S) for curve in curves], axis=1) for k in (-2, -1, 0, 1, 2)]
        for curves in (moving.angles, moving.position)
    )
    yaw_rate, pitch_rate, roll_rate = ((angles[0] - 8.0 * angles[1] + 8.0 * angles[3] - angles[4]) / (12.0 * H_S)).T
    accel_w = (-places[0] + 16.0 * places[1] - 30.0 * places[2] + 16.0 * places[3] - places[4]) / (12.0 * H_S**2)
    _, pitch, roll = angles[2].T
    rate = [
        roll_rate - yaw_rate * np.sin(pitch),
        pitch_rate * np.cos(roll) + yaw_rate * np.cos(pitch) * np.sin(roll),
        -pitch_rate * np.sin(roll) + yaw_rate * np.cos(pitch) * np.cos(roll),
    ]
    return np.stack(rate, axis=1), np.asarray(attitude(moving, t).inv().apply(accel_w - G_W))


def attitude(moving: Motion, t: Times) -> Rotation:
    """Body to world."""
    return Rotation.from_euler("ZYX", np.stack([curve(t) for curve in moving.angles], axis=1))


Readings = tuple[Vectors, Vectors]
PLANTED: dict[str, Callable[[Motion, Times, Vectors, Vectors], Readings]] = {
    "gyro_scale": lambda _, __, w, f: (w * (1.0 + np.array([0.02, -0.015, 0.03])), f),
    "accel_scale": lambda _, __, w, f: (w, f * (1.0 + np.array([0.02, -0.03, 0.01]))),
    "gyro_misalignment": lambda _, __, w, f: (w + w @ np.array([[0, 0.02, 0], [0, 0, -0.015], [0.01, 0, 0]]).T, f),
    "clock_offset": lambda m, t, _, __: readings(m, t + 0.005),
    "vibration": lambda _, t, w, f: (
        w + np.outer(np.sin(2.0 * np.pi * 33.7 * t), [0.01, 0.003, 0.005]),
        f + np.outer(np.sin(2.0 * np.pi * 33.7 * t), [0.09, 0.15, 0.3]),
    ),
    "lever_arm": lambda m, t, w, f: (w, f + arm(m, t, w, np.array([0.15, -0.1, 0.05]))),
    "gyro_bias_drift": lambda _, t, w, f: (w + np.outer(t, [4e-4, -3e-4, 5e-4]), f),
}


def arm(moving: Motion, t: Times, rate: Vectors, r: Float64[np.ndarray, "3"]) -> Vectors:
    """What a lever arm adds to the specific force."""
    alpha = (readings(moving, t + 1e-3)[0] - readings(moving, t - 1e-3)[0]) / 2e-3
    return np.asarray(np.cross(alpha, r) + np.cross(rate, np.cross(rate, r)))


def sampled(rig: Rig, over: int, rng: Generator, fine: Vectors, density: float, bias: float, lsb: float) -> Vectors:
    """Samples of one sensor: filtered, with a bias that walks, noise, and digits."""
    if rig.filter_hz is not None:
        b, a = butter(2, rig.filter_hz, fs=rig.imu_hz * over)
        fine = lfilter(b, a, fine - fine[0], axis=0) + fine[0]
    white, walk = density * rng.normal(size=(2, len(fine[::over]), 3))
    noise = white * np.sqrt(rig.imu_hz) + 0.05 * np.cumsum(walk, axis=0) / np.sqrt(rig.imu_hz)
    values = fine[::over] + bias * rng.normal(size=3) + noise
    return np.asarray(lsb * np.round(values / lsb)) if lsb else values


def recording(kind: str, rig: Rig, rng: Generator, start_ns: int, planted: str = "") -> Recording:
    """What the sensor of a body records, with true poses."""
    moving = motion(kind, rng, rig.duration_s)
    over = 1 if rig.filter_hz is None else int(np.ceil(FILTERED_HZ / rig.imu_hz))
    fine_s = np.arange((int(rig.duration_s * rig.imu_hz) - 1) * over + 1) / (rig.imu_hz * over)
    sensed = readings(moving, fine_s)
    if planted:
        sensed = PLANTED[planted](moving, fine_s, *sensed)
    gyro, accel = (sampled(rig, over, rng, *of_sensor) for of_sensor in zip(sensed, *rig.device, strict=True))
    t_s = np.arange(int(rig.duration_s * rig.pose_hz)) / rig.pose_hz
    p = np.stack([curve(t_s) for curve in moving.position], axis=1) + rig.pose_std[0] * rng.normal(size=(len(t_s), 3))
    q = attitude(moving, t_s) * Rotation.from_rotvec(rig.pose_std[1] * rng.normal(size=(len(t_s), 3)))
    stamps_ns, poses_ns = (start_ns + np.round(t * 1e9).astype(np.int64) for t in (fine_s[::over], t_s))
    truth = Poses(poses_ns, p, q.as_quat(scalar_first=True))
    return Recording(kind, Imu(stamps_ns, gyro, accel), truths={"/truth": truth})


def pair(seed: int, number: int, planted: str = "") -> tuple[str, Recording, Recording]:
    """What they are, a recording, and a right simulation of another motion."""
    rng = default_rng([seed, number])
    kind = KINDS[number % len(KINDS)]
    other = kind if rng.random() < 0.7 else str(rng.choice(KINDS))
    filters_hz = FILTERS_HZ.get(kind, (20.0, 40.0, 80.0) if rng.random() < 0.35 else None)
    imu_hz = float(rng.choice([100, 200, 250, 400]))
    rig = Rig(
        duration_s=rng.uniform(40.0, 70.0),
        imu_hz=imu_hz,
        pose_hz=float(rng.choice([20, 50, 100] if kind == "underwater" else [50, 100, 120, 200])),
        pose_std=(float(rng.choice([1e-5, 1e-4, 5e-4])), float(rng.choice([1e-5, 2e-4, 1e-3]))),
        device=DEVICES[rng.integers(len(DEVICES))],
        filter_hz=None if filters_hz is None else min(float(rng.choice(filters_hz)), 0.4 * imu_hz),
    )
    of_sim = replace(rig, duration_s=rng.uniform(40.0, 70.0))
    if rng.random() < 0.4:  # a simulator's own poses
        of_sim = replace(of_sim, pose_std=(1e-7, 1e-7), pose_hz=float(rng.choice([100, 200])))
    real = recording(kind, rig, rng, 1_700_000_000_000_000_000, planted)
    return f"{kind} and {other}", real, recording(other, of_sim, rng, 1_650_000_000_000_000_000)


def main() -> int:
    """Scores as many pairs as asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--pairs", type=int, default=27)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--planted", action="store_true")
    options = parser.parse_args()
    right = 0
    for number in range(options.pairs):
        planted = list(PLANTED)[number % len(PLANTED)] if options.planted else ""
        kinds, real, sim = pair(options.seed, number, planted)
        with TemporaryDirectory() as folder:
            paths = [Path(folder, f"{name}.mcap") for name in ("real", "sim")]
            write(real, paths[0])
            write(sim, paths[1])
            try:
                found = [finding.effect for finding in diagnose([paths[0]], paths[1]).findings]
            except ImutoolError as error:
                found = [str(error)]
        right += (is_right := found == ([planted] if planted else []))
        if not is_right:
            print(f"pair {number} ({kinds}), {planted or 'nothing'}: {', '.join(found) or 'nothing'}", flush=True)
    print(f"{right} of {options.pairs} right")
    return 0


if __name__ == "__main__":
    sys.exit(main())
