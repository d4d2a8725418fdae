"""Blind cases of wrong simulators: a motion in closed form, one fault or none, and what `imutool audit` says of it.

`python tests/bench/audit.py --cases 200 --seed 11`. The generator shares no code with the audit: positions and Euler angles are
sums of sines, rates and accelerations are derivatives of these. A quarter of the cases has no fault. A name is right if it is
the only one. Where noise is not what is asked for, a third of the simulators has none.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float64
from numpy.random import Generator, default_rng
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from imutool.config import build
from imutool.diagnosis.audit import simulator_faults
from imutool.noise.datasheet import Noise
from imutool.recording import Imu, Poses, Recording

H_S = 1e-4  # of central differences of the attitude
G_W = np.array([0.0, 0.0, -9.81])
Vectors = Float64[np.ndarray, "n 3"]


@dataclass(frozen=True)
class Motion:
    """Sums of sines: position (m) and Euler angles (rad), by amplitude, frequency (Hz) and phase."""

    p: Float64[np.ndarray, "3 3 4"]
    angles: Float64[np.ndarray, "3 3 4"]

    @classmethod
    def drawn(cls, rng: Generator) -> Motion:
        """A lively motion: metres, half a radian, up to a few hertz."""

        def sines(size: float, fastest: float) -> Float64[np.ndarray, "3 3 4"]:
            f = np.exp(rng.uniform(np.log(0.15), np.log(fastest), (3, 4)))
            return np.stack([size * rng.uniform(0.3, 1.0, (3, 4)) / (1.0 + 3.0 * f), f, rng.uniform(0, 2 * np.pi, (3, 4))])

        return cls(sines(2.0, 1.5), sines(1.2, 2.0))

    def position(self, t: Float64[np.ndarray, " n"], order: int = 0) -> Vectors:
        """Position or its derivative."""
        return _sum(self.p, t, order)

    def attitude(self, t: Float64[np.ndarray, " n"]) -> Rotation:
        """Body to world."""
        return Rotation.from_euler("ZYX", _sum(self.angles, t, 0))

    def rate(self, t: Float64[np.ndarray, " n"]) -> Vectors:
        """Angular rate in the body."""
        return np.asarray((self.attitude(t - H_S).inv() * self.attitude(t + H_S)).as_rotvec() / (2.0 * H_S))

    def force(self, t: Float64[np.ndarray, " n"], gravity: float = 1.0, arm: Float64[np.ndarray, "3"] | None = None) -> Vectors:
        """Specific force in the body, of the point of the poses or another."""
        force = self.attitude(t).inv().apply(self.position(t, 2) - gravity * G_W)
        if arm is not None:
            rate, alpha = self.rate(t), (self.rate(t + 1e-3) - self.rate(t - 1e-3)) / 2e-3
            force = force + np.cross(alpha, arm) + np.cross(rate, np.cross(rate, arm))
        return np.asarray(force)


def _sum(sines: Float64[np.ndarray, "3 3 4"], t: Float64[np.ndarray, " n"], order: int) -> Vectors:
    size, f, phase = sines
    w = 2.0 * np.pi * f
    wave = np.sin(w * t[:, None, None] + phase + order * np.pi / 2.0)
    return np.asarray((size * w**order * wave).sum(axis=2))


@dataclass
class Case:
    """What a simulator computes; a fault changes some of it."""

    motion: Motion
    rng: Generator
    t: Float64[np.ndarray, " n"]
    gyro: Vectors
    accel: Vectors
    density: Float64[np.ndarray, "6"]
    walk: Float64[np.ndarray, "6"]
    period_s: float
    noisy: bool = True
    walks: bool = True
    sample_std: Float64[np.ndarray, "6"] | None = None  # instead of the density's
    after: Callable[[Float64[np.ndarray, "n 6"]], Float64[np.ndarray, "n 6"]] = lambda x: x
    real_arm: Float64[np.ndarray, "3"] | None = None
    real_after: Callable[[Float64[np.ndarray, "n 6"]], Float64[np.ndarray, "n 6"]] = lambda x: x
    real_hz: float | None = None  # a recording is given, at this rate
    sheet: bool = False


def coordinate(c: Case) -> None:
    """Gravity left out."""
    c.accel = c.motion.force(c.t, 0.0)


def doubled(c: Case) -> None:
    """Gravity twice."""
    c.accel = c.motion.force(c.t, 2.0)


def sign(c: Case) -> None:
    """Gravity the wrong way."""
    c.accel = c.motion.force(c.t, -1.0)


def transport(c: Case) -> None:
    """Derivative of the velocity in the body."""
    h = 1e-4
    v = [c.motion.attitude(c.t + s).inv().apply(c.motion.position(c.t + s, 1)) for s in (-h, h)]
    c.accel = (v[1] - v[0]) / (2.0 * h) + c.motion.attitude(c.t).inv().apply(-np.tile(G_W, (len(c.t), 1)))


def arm(c: Case) -> None:
    """Another point than the one of the poses."""
    c.accel = c.motion.force(c.t, arm=c.rng.uniform(0.05, 0.3, 3) * c.rng.choice([-1, 1], 3))


def centre(c: Case) -> None:
    """The recording's sensor sits off the body's centre."""
    c.real_arm, c.real_hz = c.rng.uniform(0.05, 0.3, 3) * c.rng.choice([-1, 1], 3), 1.0 / c.period_s


def accel_difference(c: Case) -> None:
    """Acceleration by backward difference."""
    a = (c.motion.position(c.t, 1) - c.motion.position(c.t - c.period_s, 1)) / c.period_s
    c.accel = c.motion.attitude(c.t).inv().apply(a - G_W)


def gyro_difference(c: Case) -> None:
    """Rate by backward difference."""
    c.gyro = (c.motion.attitude(c.t - c.period_s).inv() * c.motion.attitude(c.t)).as_rotvec() / c.period_s


def shifted(c: Case, steps: float) -> None:
    """Both late, or early, by a step."""
    t = c.t - steps * c.period_s
    c.gyro, c.accel = c.motion.rate(t), c.motion.force(t)


def world(c: Case) -> None:
    """One or both in the world frame."""
    which = c.rng.integers(3)
    R = c.motion.attitude(c.t)
    c.gyro = R.apply(c.gyro) if which != 1 else c.gyro
    c.accel = R.apply(c.accel) if which != 0 else c.accel


def euler(c: Case) -> None:
    """Rates of the angles, of which the first is the yaw."""
    c.gyro = _sum(c.motion.angles, c.t, 1)[:, ::-1].copy()


def clock(c: Case) -> None:
    """The physics runs faster or slower than the clock of the stamps."""
    s = float(c.rng.choice([0.5, 0.8, 1.3, 2.0]))
    gravity = c.motion.attitude(c.t).inv().apply(np.tile(G_W, (len(c.t), 1)))
    c.gyro, c.accel = s * c.gyro, s**2 * (c.accel + gravity) - gravity


def turned(c: Case) -> None:
    """A mount that nobody states."""
    R = Rotation.from_rotvec(c.rng.uniform(0.1, 0.6, 3) * c.rng.choice([-1.0, 1.0], 3))
    c.gyro, c.accel = R.apply(c.gyro), R.apply(c.accel)


def axes(c: Case, *, handed: bool) -> None:
    """Axes permuted or flipped."""
    P = np.eye(3)[c.rng.permutation(3)] * c.rng.choice([-1.0, 1.0], 3)[:, None]
    if (np.linalg.det(P) < 0.0) != handed:
        P = -P
    P = P if handed or not np.array_equal(P, np.eye(3)) else P[[1, 2, 0]]
    c.gyro, c.accel = c.gyro @ (P.T * (np.linalg.det(P) if c.rng.random() < 0.5 else 1.0)), c.accel @ P.T


def per_sample(c: Case) -> None:
    """Noise of a sample at the recording's rate, or a density taken for it."""
    if c.rng.random() < 0.5:
        c.sheet, c.sample_std = True, c.density
    else:
        c.real_hz = 1.0 / c.period_s * (4.0 if c.period_s > 4e-3 else 0.25)
        c.sample_std = c.density * np.sqrt(c.real_hz)


def no_walk(c: Case) -> None:
    """A bias that stays."""
    c.sheet, c.walks = True, False


def silent(c: Case) -> None:
    """No noise."""
    c.sheet, c.noisy, c.walks = True, False, False


def clip(c: Case) -> None:
    """The recording is clipped."""
    limit = 0.6 * np.abs(np.concatenate([c.gyro, c.accel], axis=1)).max(axis=0)
    limit = np.repeat([limit[:3].max(), limit[3:].max()], 3)
    c.real_hz, c.real_after = 1.0 / c.period_s, lambda x: np.clip(x, -limit, limit)


def digits(c: Case) -> None:
    """The recording has digits."""
    lsb = c.rng.uniform(0.8, 3.0) * np.repeat([c.density[0], c.density[3]], 3) / np.sqrt(c.period_s)
    c.real_hz, c.real_after = 1.0 / c.period_s, lambda x: lsb * np.round(x / lsb)


def bandwidth(c: Case) -> None:
    """The recording's noise is filtered."""
    a = c.rng.uniform(0.2, 0.45)
    c.real_hz, c.real_after = 1.0 / c.period_s, lambda x: np.asarray(lfilter([a], [1.0, a - 1.0], x - x[:1], axis=0) + x[:1])


def step_lines(c: Case) -> None:
    """The solver's step as a line."""
    f = c.rng.uniform(0.2, 0.45) / c.period_s
    size = c.rng.uniform(0.3, 1.0) * np.repeat(np.median(c.density.reshape(2, 3), axis=1), 3) / np.sqrt(c.period_s)
    size[:3] *= c.rng.integers(2)
    c.after = lambda x: x + size * np.sin(2.0 * np.pi * f * c.t[:, None])


def repeated(c: Case) -> None:
    """Each value held for some samples."""
    every = int(c.rng.integers(2, 5))
    c.after = lambda x: x[np.arange(len(x)) // every * every]


FAULTS: dict[str, Callable[[Case], None]] = {
    "coordinate_acceleration": coordinate,
    "gravity_doubled": doubled,
    "gravity_sign": sign,
    "transport_term": transport,
    "lever_arm": arm,
    "body_centre": centre,
    "backward_difference": accel_difference,
    "backward_difference (gyro)": gyro_difference,
    "step_delay": partial(shifted, steps=1.0),
    "early_stamps": partial(shifted, steps=-1.0),
    "world_frame": world,
    "other_clock": clock,
    "euler_rates": euler,
    "turned_axes": turned,
    "left_handed": partial(axes, handed=True),
    "permuted_axes": partial(axes, handed=False),
    "noise_per_sample": per_sample,
    "bias_never_walks": no_walk,
    "noise_absent": silent,
    "clipping_absent": clip,
    "digits_absent": digits,
    "bandwidth_absent": bandwidth,
    "step_lines": step_lines,
    "repeated_samples": repeated,
}
NOISE_FAULTS = ("noise_per_sample", "step_lines")  # which need noise


def made(name: str, seed: int, duration_s: float = 60.0) -> tuple[Recording, Recording | None, Noise]:
    """A simulation with one fault, or with none; a recording and a data sheet where the fault needs them."""
    rng = default_rng([seed, 909])
    motion, rate_hz = Motion.drawn(rng), float(rng.choice([100.0, 125.0, 200.0, 250.0, 400.0]))
    t = np.arange(round(duration_s * rate_hz)) / rate_hz
    density = np.repeat(np.exp(rng.uniform(np.log([5e-5, 1e-3]), np.log([3e-4, 5e-3]))), 3)
    walk = np.repeat([0.6, 1.2], 3) * density / np.sqrt(2.0)
    c = Case(motion, rng, t, motion.rate(t), motion.force(t), density, walk, 1.0 / rate_hz)
    if name in FAULTS:
        FAULTS[name](c)
    else:
        c.sheet, c.real_hz = bool(rng.integers(2)), rate_hz * float(rng.choice([1.0, 2.0, 0.5])) if rng.integers(2) else None
    if not c.sheet and c.real_hz is None and name not in NOISE_FAULTS and default_rng([seed, 910]).random() < 1.0 / 3.0:
        c.noisy = c.walks = False
    std = c.sample_std if c.sample_std is not None else density * np.sqrt(rate_hz)
    bias = rng.normal(size=6) * np.repeat([0.01, 0.1], 3)
    sim = np.concatenate([c.gyro, c.accel], axis=1) + bias
    sim = sim + c.noisy * std * rng.normal(size=sim.shape)
    sim = sim + c.walks * walk / np.sqrt(rate_hz) * np.cumsum(rng.normal(size=sim.shape), axis=0)
    values = {
        f"{s}_{k}": (float(x[3 * n]),) * 3
        for n, s in enumerate(("gyro", "accel"))
        for k, x in (("density", density), ("walk", walk))
    }
    sheet = build(Noise, values) if c.sheet else Noise()
    return _log(motion, t, c.after(sim)), _real(c, rng), sheet


def _real(c: Case, rng: Generator) -> Recording | None:
    if c.real_hz is None:
        return None
    t = np.arange(round(60.0 * c.real_hz)) / c.real_hz
    samples = np.concatenate([c.motion.rate(t), c.motion.force(t, arm=c.real_arm)], axis=1)
    return _log(c.motion, t, c.real_after(samples + c.density * np.sqrt(c.real_hz) * rng.normal(size=samples.shape)))


def _log(motion: Motion, t: Float64[np.ndarray, " n"], samples: Float64[np.ndarray, "n 6"]) -> Recording:
    t_ns = 1_700_000_000_000_000_000 + np.round(t * 1e9).astype(np.int64)
    q = motion.attitude(t).as_quat(scalar_first=True)
    imu = Imu(t_ns, np.ascontiguousarray(samples[:, :3]), np.ascontiguousarray(samples[:, 3:]))
    return Recording("case", imu, truths={"/ground_truth/pose": Poses(t_ns, motion.position(t), q)})


def main() -> int:
    """Scores as many cases as asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--cases", type=int, default=84)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    kinds = list(FAULTS)
    named, cases, false, nulls = Counter[str](), Counter[str](), 0, 0
    for k in range(options.cases):
        kind = "null" if k % 4 == 3 else kinds[(k - k // 4) % len(kinds)]
        said = {fault.fault for fault in simulator_faults(*made(kind, options.seed * 100_000 + k))}
        right = said == ({kind.partition(" ")[0]} if kind != "null" else set())
        cases[kind] += 1
        named[kind] += right
        if not right:
            print(f"case {k} ({kind}): {', '.join(sorted(said)) or 'nothing'}", flush=True)
    nulls, false = cases["null"], cases["null"] - named["null"]
    faults = sum(cases.values()) - nulls
    print(f"named {sum(named.values()) - named['null']} of {faults} faults; {false} of {nulls} right simulators accused")
    return 0


if __name__ == "__main__":
    sys.exit(main())
