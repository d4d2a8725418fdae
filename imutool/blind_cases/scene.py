"""Scene of a blind case.

A motion with noise and channels, and the samples of a sensor along it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.random import Generator
from scipy.interpolate import make_interp_spline

from imutool.array_types import Float64, Int64, Rows6
from imutool.blind_cases import catalogue
from imutool.blind_cases.effects import Model, Reading, Stage, Theta, Times
from imutool.blind_cases.motion import SHORTEST_S, Kinematics, Motion, Smoother
from imutool.errors import ConfigError, DataError
from imutool.noise.datasheet import Noise
from imutool.recording import Imu, Poses

RATE_HZ, POSE_RATE_HZ, GRID_HZ = 200.0, 100.0, 1000.0
MARGIN_S = 2.5  # of motion before and after the log: filters settle in it, shifted clocks read from it
SETTLE_S = 2.0
EPOCH_NS = 1_700_000_000_000_000_000  # of every case: the start time reveals nothing
SIM_SHARE = 0.3  # of the real sensor's noise
FILTERS = {"gyro_delay", "low_pass", "mount_resonance"}
JITTER_MAX_S = 2.4e-3  # neighbours 5 ms apart keep their order

Acting = Sequence[tuple[Model, Theta]]


@dataclass(frozen=True, eq=False)
class Scene:
    """Motion, noise (by column) and channels of a case; seconds count from the log's start."""

    smoother: Smoother
    motion: Motion
    start_s: float
    duration_s: float
    noise: Float64[np.ndarray, "6"]
    channel_t_s: Times
    channels: dict[str, Times] = field(default_factory=dict)

    @property
    def t_s(self) -> Times:
        """Sample times of a true clock."""
        return np.arange(int(self.duration_s * RATE_HZ) + 1) / RATE_HZ

    @property
    def sigma(self) -> Float64[np.ndarray, "6"]:
        """Standard deviation of a real minus a simulated sample, by column."""
        return np.asarray(self.noise * np.hypot(1.0, SIM_SHARE))

    def kinematics(self, t_s: Times) -> Kinematics:
        """Kinematics of the tracked point."""
        return replace(self.motion.kinematics(t_s + self.start_s), t_s=np.asarray(t_s, dtype=np.float64))

    def ideal(self, t_s: Times) -> Rows6:
        """Samples of an ideal sensor."""
        ideal = self.kinematics(t_s)
        return np.concatenate([ideal.omega, ideal.f], axis=1)

    def channels_at(self, t_s: Times) -> dict[str, Times]:
        """Channels at some times."""
        return {topic: np.interp(t_s, self.channel_t_s, values) for topic, values in self.channels.items()}

    def converter_input(self, acting: Acting, t_s: Times) -> Rows6:
        """Signal before the converter, without noise, a row for each true-clock time of a sample."""
        order = sorted(acting, key=lambda pair: _place(pair[0]))
        taken = np.asarray(t_s, dtype=np.float64)
        for model, theta in order:
            if model.stage == Stage.CLOCK:
                taken = model.act(taken, theta)
        mounted = [(m, theta) for m, theta in order if m.stage in (Stage.MOUNT, Stage.BANDWIDTH)]
        signal = self._through_mount(order, mounted, taken)
        for model, theta in order:
            if model.stage == Stage.SENSOR:
                signal = model.act(Reading(t_s, signal, self.channels_at(t_s)), theta)
        return signal

    def _through_mount(self, order: Acting, mounted: Acting, taken: Times) -> Rows6:
        dynamic = any(model.name in FILTERS for model, _ in mounted)
        first = min(float(taken[0]), 0.0) - SETTLE_S
        count = int((float(taken[-1]) + 0.2 - first) * GRID_HZ)
        grid = first + np.arange(count) / GRID_HZ if dynamic else taken
        ideal = self.kinematics(grid)
        signal = np.concatenate([ideal.omega, ideal.f], axis=1)
        signal = signal + sum((m.act(ideal, theta) for m, theta in order if m.stage == Stage.IDEAL), np.zeros(6))
        for model, theta in mounted:
            signal = model.act(GRID_HZ, signal, theta)
        return np.asarray(make_interp_spline(grid, signal, k=3)(taken)) if dynamic else signal

    def converter_output(self, acting: Acting, signal: Rows6) -> Rows6:
        """Signal after the converter: clipped, then rounded."""
        rank = {"saturation": 0, "quantization": 1}
        for model, theta in sorted(acting, key=lambda pair: rank.get(pair[0].name, 0)):
            if model.stage == Stage.CONVERTER:
                signal = model.act(signal, theta)
        return signal

    def reference(self, acting: Acting) -> Motion:
        """Motion of the reference, which bridges the poses that it lost."""
        for model, theta in acting:
            if model.stage == Stage.REFERENCE:
                return self.smoother.motion(self.lost_intervals(theta))
        return self.motion

    def lost_intervals(self, theta: Theta) -> tuple[tuple[float, float], ...]:
        """Intervals that the reference lost, on the clock of its poses (s)."""
        return tuple((self.start_s + start, self.start_s + start + float(theta[0])) for start in theta[1:].tolist())

    def expected(self, acting: Acting, t_s: Times) -> Rows6:
        """Samples of the simulation without noise: ideal, along the reference."""
        return replace(self, motion=self.reference(acting)).ideal(t_s)

    def misfit(self, acting: Acting, t_s: Times) -> Rows6:
        """Real minus simulated samples, without noise and bias."""
        return np.asarray(self.converter_output(acting, self.converter_input(acting, t_s)) - self.expected(acting, t_s))

    # ── logs ──

    def real(self, acting: Acting, bias: Theta, rng: Generator) -> tuple[Imu, dict[str, float]]:
        """Samples with effects, bias and noise, and the realised sizes of the effects of the stamps."""
        t_s = self.t_s
        signal = self.converter_input(acting, t_s) + bias + self.noise * rng.standard_normal((len(t_s), 6))
        signal = self.converter_output(acting, signal)
        kept, stamps, came_to = np.ones(len(t_s), dtype=bool), t_s, {}
        for model, theta in acting:
            if model.name == "dropped_samples":
                kept[1:-1] = rng.random(len(t_s) - 2) >= theta[0]
                came_to = {"share": float(1.0 - kept.mean()), "count": float(np.sum(~kept))}
            if model.name == "timestamp_jitter":
                late = np.clip(theta[0] * rng.standard_normal(len(t_s)), -JITTER_MAX_S, JITTER_MAX_S)
                late[[0, -1]] = 0.0
                stamps, came_to = t_s + late, {"std": float(late.std())}
        return _imu(stamps[kept], signal[kept]), came_to

    def simulated(self, acting: Acting, rng: Generator) -> Imu:
        """Samples of the simulation: ideal, along the reference, with a small noise."""
        ideal = self.expected(acting, self.t_s)
        return _imu(self.t_s, ideal + SIM_SHARE * self.noise * rng.standard_normal(ideal.shape))

    def poses(self, acting: Acting, noise: tuple[float, float], rng: Generator) -> Poses:
        """Poses of the reference, with noise (m, rad)."""
        t_s = np.arange(int(self.duration_s * POSE_RATE_HZ) + 1) / POSE_RATE_HZ
        p_wb, q_wxyz = self.reference(acting).pose(t_s + self.start_s)
        p_wb = p_wb + noise[0] * rng.standard_normal(p_wb.shape)
        half = 0.5 * noise[1] * rng.standard_normal(p_wb.shape)
        w, v = q_wxyz[:, :1], q_wxyz[:, 1:]
        turned = np.concatenate([w - np.sum(v * half, axis=1)[:, None], v + w * half + np.cross(v, half)], axis=1)
        turned /= np.linalg.norm(turned, axis=1, keepdims=True)
        return Poses(stamps_ns(t_s), p_wb, turned)


def stamps_ns(t_s: Times) -> Int64[np.ndarray, " n"]:
    """Stamps on the log's clock (ns)."""
    out: Int64[np.ndarray, " n"] = EPOCH_NS + np.round(t_s * 1e9).astype(np.int64)
    return out


def place_scene(smoother: Smoother, noise: Noise, rng: Generator, longest_s: float) -> Scene:
    """Scene at a random start of a trajectory, at most `longest_s` long.

    Raises:
        ConfigError: unknown or zero noise.
        DataError: a scene too short for its poses to be smoothed when the case is opened.
    """
    density = np.concatenate([noise.values("gyro_density"), noise.values("accel_density")])
    if not (np.isfinite(density).all() and (density > 0.0).all()):
        raise ConfigError(
            "the noise is zero or unknown, and effects are sized by it",
            where="noise",
            expected="gyro_density and accel_density above zero on every axis",
        )
    motion = smoother.motion()
    room = motion.last_s - motion.first_s - 2.0 * MARGIN_S
    duration = np.floor(min(longest_s, room))
    if duration < SHORTEST_S:
        raise DataError(
            f"a case of {duration:g} s",
            expected=f"at least {SHORTEST_S:g} s, and {MARGIN_S:g} s of the trajectory before and after it",
            fix="Choose a longer trajectory, or a larger `longest_s`",
        )
    start = motion.first_s + MARGIN_S + rng.uniform(0.0, max(room - duration, 0.0))
    channel_t = np.arange(int(duration * catalogue.RATE_HZ) + 1) / catalogue.RATE_HZ
    scene = Scene(smoother, motion, float(start), float(duration), density * np.sqrt(RATE_HZ), channel_t)
    return replace(scene, channels=catalogue.channels(rng, channel_t, scene.ideal(channel_t)))


def _imu(t_s: Times, signal: Rows6) -> Imu:
    return Imu(stamps_ns(t_s), np.ascontiguousarray(signal[:, :3]), np.ascontiguousarray(signal[:, 3:]))


def _place(model: Model) -> tuple[int, int, str]:
    """Place of a model: its stage, there gains before what is added, by name, and G f while f is the ideal force."""
    biases = ("bias_drift", "bias_step", "temperature")
    rank = 3 if model.name.endswith(biases) else 2 if model.name.startswith("accel") else 0
    return model.stage, 1 if model.name == "gyro_g_sensitivity" else rank, model.name
