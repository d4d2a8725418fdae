"""A simulated recording: an IMU along any trajectory with poses, with the effects of a physics.toml and a sensor's noise.

Poses become a smooth motion (`motion`), the motion what an ideal IMU feels, the effects act on that in the order of their
stages (`effects._forward`), noise joins behind the sensor and before its converter; the log holds the samples beside the truth.
White noise has standard deviation density * sqrt(rate), the bias walks by walk * sqrt(dt) a sample from zero (IEEE 952);
the instability of a data sheet, a floor of the Allan deviation, is not simulated beside a walk.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from imutool.errors import ConfigError, DataError, ImutoolError, LogError
from imutool.mcap_io.batches import PoseBatch
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read as read_log
from imutool.mcap_io.write import write
from imutool.noise import datasheet as noises
from imutool.recording import Imu, Poses, Recording, seconds, unit_quaternions
from imutool.sensor import physics_file
from imutool.sensor.effect import Acting, Effect, Stage, Theta, distort
from imutool.sensor.physics_file import DRIVEN, PhysicsFile
from imutool.sensor.samples import IdealMotion, SensorSamples
from imutool.sensor.trajectory import Smoothed, smooth_motion

SCHEMA = "imutool.simulation/1"
RATE_HZ = 200.0  # of a trajectory without an IMU
SLOWEST_HZ, FASTEST_HZ = 10.0, 4000.0
LEAST_S = 2.0  # of trusted motion
FELT_HZ = 400.0  # of the motion's clock, at least: filters and shifts act on it before samples are taken
MOTION_TOPIC = "/motion/pose"  # the exact motion of the samples, beside the truth that it was smoothed from
TRUTH_TOPIC = "/ground_truth/pose"
NOISE = "~noise"  # within the stage SENSOR effects act by name: behind all, and before the converter

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True, eq=False)
class Simulation:
    """The recording, the motion it was made from, and what was done."""

    recording: Recording
    motion: Smoothed
    settings: Mapping[str, Any]
    remarks: tuple[str, ...]

    def plain(self) -> dict[str, Any]:
        """As JSON."""
        motion = self.motion
        return {
            "schema": SCHEMA,
            **self.settings,
            "samples": len(self.recording.imu),
            "duration_s": motion.duration_s,
            "stretches_s": [[one.start_s, one.end_s] for one in motion.stretches],
            "motion": {
                "pose_noise_m": [one.noise_m for one in motion.stretches],
                "pose_noise_rad": [one.noise_rad for one in motion.stretches],
                "cutoff_hz": [list(one.cutoff_hz) for one in motion.stretches],
                "gyro_std_rad_s": motion.gyro_std,
                "accel_std_m_s2": motion.accel_std,
                "glitches": motion.glitches,
                "steps": motion.steps,
            },
            "remarks": list(self.remarks),
        }


def simulate(
    trajectory: Path,
    out: Path,
    *,
    physics: Path | None = None,
    noise: str | Path = "none",
    rate_hz: float | None = None,
    seed: int = 0,
    truth: str | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Simulation:
    """Simulates an IMU along the poses of a log and writes the log `out`; see `simulated`.

    `physics` is a physics.toml, `noise` a data sheet's name or a TOML file. Without `rate_hz` the rate is that of the log's own
    first IMU, 200 Hz where it has none.

    Raises:
        ConfigError: a setting, a file of settings or the target.
        LogError: the log has no poses, or is damaged.
        DataError: less than 2 s of the motion can be trusted, or an effect lacks a channel.
    """
    tell = progress or (lambda done, total, word: None)
    file = PhysicsFile() if physics is None else physics_file.read(physics)
    acting = file.acting(where=physics or "physics")
    sheet = noises.read(noise)
    if out.exists() and out.samefile(trajectory):
        raise ConfigError("is the trajectory itself", where=out, expected="another OUT")
    tell(0, 4, "reading")
    source = _source(trajectory, truth)
    own_rate = 1.0 / source.imu.period_s if len(source.imu) > 1 else RATE_HZ
    tell(1, 4, "smoothing")
    try:
        found = simulated(source, acting, sheet, _rounded(own_rate) if rate_hz is None else rate_hz, seed)
    except ImutoolError as error:
        raise error.at(trajectory) from error
    tell(2, 4, "writing")
    asked = {
        "command": "simulate",
        "trajectory": trajectory.name,
        "truth": next(iter(source.truths)),
        "physics": physics_file.plain(file),
        "noise": noises.plain(sheet) | {"name": str(noise)},
        **found.settings,
    }
    texts = {key: value if isinstance(value, str) else json.dumps(value, ensure_ascii=False) for key, value in asked.items()}
    recording = replace(found.recording, name=out.stem, metadata={**source.metadata, "imutool": texts})
    write(recording, out, overwrite=overwrite)
    tell(4, 4, "")
    return replace(found, recording=recording, settings=asked | {"output": str(out)})


def simulated(source: Recording, acting: Acting, noise: noises.Noise, rate_hz: float, seed: int) -> Simulation:
    """An IMU along the (first) true poses of a recording: samples on a regular clock over every trusted stretch of the motion.

    Stamps are whole periods after the first pose, on the clock of the poses. Samples that an effect of the clock takes outside
    a stretch are left out. The true poses in a stretch are copied as they are; `/motion/pose` holds the motion itself.

    Raises:
        ConfigError: the rate or the seed.
        DataError: no poses, less than 2 s of the motion can be trusted, an effect lacks a channel.
    """
    if not SLOWEST_HZ <= rate_hz <= FASTEST_HZ:
        raise ConfigError(f"a rate of {rate_hz:g} Hz", where="--rate", expected=f"{SLOWEST_HZ:g} to {FASTEST_HZ:g} Hz")
    if seed < 0:
        raise ConfigError(f"seed {seed} is negative", where="--seed", expected="0 or more")
    motion = smooth_motion(source.truth)
    if motion.duration_s < LEAST_S:
        raise DataError(
            f"{motion.duration_s:.2f} s of the motion can be trusted",
            expected=f"{LEAST_S:g} s of poses without a hole, and more",
            fix="Give a longer trajectory",
        )
    remarks = _remarks(motion, source.truth, noise)
    felts = motion.felt(rate_hz * max(1, int(np.ceil(FELT_HZ / rate_hz))))
    needed = any(physics.needs or physics.name == DRIVEN for physics, _ in acting)
    if needed:
        felts = [replace(felt, channels=_channels(source, motion.start_ns, felt.t_s)) for felt in felts]
    stamps = [_stamps(felt, rate_hz) for felt in felts]
    begins_s = float(stamps[0][0])  # effects count time from the first sample that is written
    since = [replace(felt, t_s=felt.t_s - begins_s) for felt in felts]
    out = read_all(since, [part - begins_s for part in stamps], [*acting, (_noise(noise, rate_hz, seed), np.zeros(0))])
    imu = Imu(_nanoseconds(motion, out.stamp_s + begins_s), out.gyro, out.accel)
    inside = motion.covers(source.truth.t_ns)
    return Simulation(
        Recording(
            name=source.name,
            imu=imu,
            truths={TRUTH_TOPIC: source.truth.rows(inside), MOTION_TOPIC: _exact(motion, felts, stamps)},
            scalars=dict(source.scalars) if needed else {},
            source=source.source,
        ),
        motion,
        {"rate_hz": rate_hz, "seed": seed},
        remarks,
    )


def read_all(felts: Sequence[IdealMotion], stamps: Sequence[Float64[np.ndarray, " _"]], acting: Acting) -> SensorSamples:
    """What a sensor with these effects reads over several stretches of one motion.

    As `_forward.read`, but clock and sensor know of no stretches: a drift goes on from one to the next, a clock jumps once.
    """
    order = sorted(acting, key=lambda pair: (pair[0].stage, pair[0].name))
    for physics, theta in order:
        if physics.stage < Stage.CLOCK:
            felts = [physics.forward(felt, theta) for felt in felts]
    stamp_s = np.concatenate(stamps)
    taken_s, piece = stamp_s, np.repeat(np.arange(len(felts)), [len(part) for part in stamps])
    for physics, theta in order:
        if physics.stage == Stage.CLOCK:
            taken_s = physics.forward(taken_s, theta)
    parts = []
    for k, felt in enumerate(felts):
        rows = (piece == k) & (taken_s >= felt.t_s[0]) & (taken_s <= felt.t_s[-1])
        if rows.any():
            parts.append(felt.taken(taken_s[rows], stamp_s[rows]))
    if not parts:
        raise DataError("the clock takes every sample outside the motion", expected="a smaller offset")
    return distort(_joined(parts), acting)


def _joined(parts: Sequence[SensorSamples]) -> SensorSamples:
    channels = {name: np.concatenate([part.channels[name] for part in parts]) for name in parts[0].channels}
    attitudes = [part.R_wb for part in parts if part.R_wb is not None]
    return SensorSamples(
        np.concatenate([part.stamp_s for part in parts]),
        np.concatenate([part.gyro for part in parts]),
        np.concatenate([part.accel for part in parts]),
        np.concatenate([part.alpha for part in parts]),
        np.concatenate(attitudes) if len(attitudes) == len(parts) else None,
        channels,
    )


def _stamps(felt: IdealMotion, rate_hz: float) -> Float64[np.ndarray, " m"]:
    """Whole periods since the first pose, within a stretch."""
    first, last = np.ceil(felt.t_s[0] * rate_hz - 1e-6), np.floor(felt.t_s[-1] * rate_hz + 1e-6)
    return np.asarray(np.arange(first, last + 1.0) / rate_hz)


def _exact(motion: Smoothed, felts: Sequence[IdealMotion], stamps: Sequence[Float64[np.ndarray, " _"]]) -> Poses:
    """The motion at the samples, with its velocity."""
    parts = []
    for stretch in motion.stretches:
        own = [s for s, felt in zip(stamps, felts, strict=True) if stretch.start_s <= felt.t_s[0] <= stretch.end_s]
        parts += [stretch.trajectory.poses(_nanoseconds(motion, stamp_s)) for stamp_s in own]
    velocities = [part.v_w for part in parts if part.v_w is not None]
    return Poses(
        np.concatenate([part.t_ns for part in parts]),
        np.concatenate([part.p_wb for part in parts]),
        np.concatenate([part.q_wb_wxyz for part in parts]),
        np.concatenate(velocities),
    )


def _nanoseconds(motion: Smoothed, stamp_s: Float64[np.ndarray, " m"]) -> Int64[np.ndarray, " m"]:
    return np.asarray(motion.start_ns + np.round(stamp_s * 1e9).astype(np.int64))


def _noise(noise: noises.Noise, rate_hz: float, seed: int) -> Effect:
    """White noise and a walking bias as an effect; what is not known is not added. Each kind has random numbers of its own."""
    known = {name: np.nan_to_num(noise.values(name)) for name in noises.UNITS}

    def forward(read: SensorSamples, _: Theta) -> SensorSamples:
        dt = np.diff(read.stamp_s, prepend=read.stamp_s[0])[:, None]  # a walk goes on in a hole
        out = []
        for k, (name, values) in enumerate((("gyro", read.gyro), ("accel", read.accel))):
            white, walk = (np.random.default_rng([seed, k, kind]).normal(size=values.shape) for kind in (0, 1))
            bias = np.cumsum(known[f"{name}_walk"] * np.sqrt(np.abs(dt)) * walk, axis=0)
            out.append(values + known[f"{name}_density"] * np.sqrt(rate_hz) * white + bias)
        return read.but(*out)

    return Effect(NOISE, Stage.SENSOR, ("gyro", "accel"), "+ n + b(t)", (), "always", forward)


def _remarks(motion: Smoothed, poses: Poses, noise: noises.Noise) -> tuple[str, ...]:
    said = []
    left_out = poses.duration_s - motion.duration_s
    if left_out > 0.05 * poses.duration_s:
        said.append(
            f"{left_out:.1f} s of {poses.duration_s:.1f} s are left out: holes and glitches of the poses, and their ends"
        )
    kinds = [name for name in noises.UNITS if "instability" not in name]
    if lacking := [name for name in kinds if np.isnan(noise.values(name)).any()]:
        said.append(f"{', '.join(lacking)} not known in the noise file, and not simulated")
    return tuple(said)


def _channels(recording: Recording, start_ns: int, t_s: Float64[np.ndarray, " n"]) -> dict[str, Float64[np.ndarray, " n"]]:
    """Other numbers of the log, straight between its messages, by topic, those of a vector by `topic.x`."""
    out = {}
    for topic, scalars in recording.scalars.items():
        if len(scalars):
            own_s, width = seconds(scalars.t_ns, start_ns), scalars.values.shape[1]
            for k, column in enumerate(scalars.values.T):
                out[topic if width == 1 else f"{topic}.{'xyz'[k]}"] = np.interp(t_s, own_s, column)
    return out


def _rounded(rate_hz: float) -> float:
    """A measured rate to a tenth of a per cent: a clock of 200.0016 Hz is one of 200."""
    whole = round(rate_hz)
    return float(whole) if whole and abs(rate_hz / whole - 1.0) < 1e-3 else rate_hz


def _source(path: Path, truth: str | None) -> Recording:
    """The log with its poses; one without an IMU gets an empty one."""
    with Log(path) as log:
        imus = log.imu_topics
        if not imus:
            return _without_imu(log, truth)
    found = read_log(path, imu=imus[0], truth=truth)
    if not found.truths:
        raise LogError("the log has no poses", where=path, expected="a topic of PoseStamped, Odometry or TF")
    return found if truth is None else found.with_truth(next(iter(found.truths)))


def _without_imu(log: Log, truth: str | None) -> Recording:
    """Poses alone: the first pose topic or the one asked for; of a tree of transforms TOPIC/CHILD_FRAME, or its only child."""
    if not log.pose_topics:
        raise LogError("the log has no poses", where=log.path, expected=f"poses among {log.listing()}")
    name = truth or log.pose_topics[0]
    topic = name if name in log.topics else max((t for t in log.pose_topics if name.startswith(f"{t}/")), key=len, default=name)
    frames: dict[str, list[PoseBatch]] = {}
    for batch in log.pose_batches(topic):
        frames.setdefault(batch.child_frame_id.lstrip("/"), []).append(batch)
    if topic != name:
        frames = {child: parts for child, parts in frames.items() if name == f"{topic}/{child}"}
    if len(frames) != 1:
        listed = ", ".join(f"{topic}/{child}" for child in frames) or "(none)"
        raise LogError(f"{len(frames)} bodies on {name}", where=log.path, expected="one", fix=f"Choose --truth out of {listed}")
    (parts,) = frames.values()
    t_ns, p_wb, q_wb = (np.concatenate([part[k] for part in parts]) for k in (3, 4, 5))
    with log.named(topic):
        poses = Poses(t_ns, p_wb, unit_quaternions(q_wb))
    none = Imu(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
    return Recording(name=log.path.stem, imu=none, truths={name: poses})
