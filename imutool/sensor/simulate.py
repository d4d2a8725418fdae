"""Simulation of an IMU along a log's poses, with effects of a physics.toml and noise.

Poses become a smooth motion (`trajectory`), the motion ideal signals, the effects act on these in the order of their stages
(`effect`). Noise is added behind the sensor and before its converter; the log holds the samples and the truth.
White noise has standard deviation density * sqrt(rate), the bias walks by walk * sqrt(dt) a sample from zero (IEEE 952);
the instability of a data sheet, a floor of the Allan deviation, is not simulated with a walk. A noise with a colour has
that spectrum at its own rate, and follows the motion as it did when it was recorded.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.config import plain
from imutool.errors import ConfigError, DataError, ImutoolError, LogError
from imutool.file_location import same_location
from imutool.geometry import quaternion
from imutool.log_info.convention_report import check_poses
from imutool.mcap_io.codec.decode import PoseBatch
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read as read_log
from imutool.mcap_io.write import write
from imutool.noise import datasheet as noises
from imutool.recording import Imu, Poses, Recording, unit_quaternions
from imutool.recording.columns import median
from imutool.report import NamedProgress, silent
from imutool.sensor import physics_file
from imutool.sensor.channels import channels_at, needs_channels, with_channels
from imutool.sensor.effect import Acting, simulate_stretches
from imutool.sensor.physics_file import PhysicsFile
from imutool.sensor.physics_file_terms import SimulatedSensor, additive_noise
from imutool.sensor.samples import IdealMotion, SensorSamples
from imutool.sensor.trajectory import SmoothMotion, smooth_motion

SCHEMA = "imutool.simulation/1"
RATE_HZ = 200.0  # of a trajectory without an IMU
SLOWEST_HZ, FASTEST_HZ = 10.0, 4000.0
MIN_S = 2.0  # of trusted motion
MAX_M_S2 = 100.0  # median acceleration; ten times gravity for half of the time is no body's
MOTION_HZ = 400.0  # of the motion's clock, at least: filters and shifts act there before samples are taken
MOTION_TOPIC = "/motion/pose"  # the exact motion of the samples; the truth that it was smoothed from is copied
TRUTH_TOPIC = "/ground_truth/pose"


@dataclass(frozen=True, eq=False)
class Simulation:
    """Simulated recording, its smooth motion (None along samples), settings and remarks."""

    recording: Recording
    motion: SmoothMotion | None = field(repr=False)
    stretches_s: Sequence[tuple[float, float]]
    settings: Mapping[str, Any] = field(repr=False)
    remarks: tuple[str, ...]

    def plain(self) -> dict[str, Any]:
        """The report as JSON values."""
        motion = self.motion
        return {
            "schema": SCHEMA,
            **self.settings,
            "samples": len(self.recording.imu),
            "duration_s": sum(end_s - start_s for start_s, end_s in self.stretches_s),
            "stretches_s": [list(stretch) for stretch in self.stretches_s],
            "motion": motion
            and {
                "pose_noise_m": [part.noise_m for part in motion.stretches],
                "pose_noise_rad": [part.noise_rad for part in motion.stretches],
                "cutoff_hz": [list(part.cutoff_hz) for part in motion.stretches],
                "gyro_std_rad_s": motion.gyro_std,
                "accel_std_m_s2": motion.accel_std,
                "glitches": motion.glitches,
                "steps": motion.steps,
            },
            "remarks": list(self.remarks),
        }


Along = Callable[[Path, str | None, SimulatedSensor], Simulation]  # from a log and its pose topic


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
    progress: NamedProgress = silent,
    along: Along | None = None,
) -> Simulation:
    """Simulate an IMU along the poses of a log and write the log `out`; see `simulated`.

    `physics` is a physics.toml, `noise` a data sheet's name or a TOML file. Without `rate_hz` the rate is that of the log's own
    first IMU, 200 Hz where it has none. `along` makes the simulation of other signals of the log than its poses.

    Raises:
        ConfigError: a setting, a file of settings or the target.
        LogError: the log has no poses, or is damaged.
        DataError: less than 2 s of trusted motion, an effect without its channel, or poses that the log's IMU contradicts.
    """
    file = PhysicsFile() if physics is None else physics_file.read(physics)
    acting, sheet = file.acting(where=physics or "physics"), noises.read(noise)
    sensor = SimulatedSensor(acting, file.start_ns, sheet, rate_hz, seed)
    if same_location(out, trajectory):
        raise ConfigError("is the trajectory itself", where=out, expected="another OUT")
    _check(rate_hz, seed)
    progress(0, 2, "simulating")
    try:
        simulation = (along or _along_poses)(trajectory, truth, sensor)
    except ImutoolError as error:
        raise error.at(trajectory) from error
    progress(1, 2, "writing")
    settings = {
        "command": "simulate",
        "trajectory": trajectory.name,
        "physics": plain(file),
        "noise": noises.plain(sheet) | {"name": str(noise)},
        **simulation.settings,
    }
    texts = {key: value if isinstance(value, str) else json.dumps(value, ensure_ascii=False) for key, value in settings.items()}
    recording = replace(simulation.recording, name=out.stem, metadata={**simulation.recording.metadata, "imutool": texts})
    write(recording, out, overwrite=overwrite)
    progress(2, 2, "")
    others = (
        f"{entry.name} of {entry.column} is no effect of an IMU, and not simulated" for entry in file.effect if entry.column
    )
    remarks = (*simulation.remarks, *others)
    return replace(simulation, recording=recording, settings=settings | {"output": str(out)}, remarks=remarks)


def _along_poses(path: Path, truth: str | None, sensor: SimulatedSensor) -> Simulation:
    source = _source(path, truth, channels=needs_channels(sensor.acting))
    check_poses(source)
    rate_hz = sensor.rate_hz or _rounded(1.0 / source.imu.period_s if len(source.imu) > 1 else RATE_HZ)
    found = simulated(source, sensor.acting, sensor.noise, rate_hz, sensor.seed, start_ns=sensor.start_ns)
    settings = {"truth": next(iter(source.truths)), "imu": None, **found.settings}
    return replace(found, recording=replace(found.recording, metadata=source.metadata), settings=settings)


def simulated(
    source: Recording, acting: Acting, noise: noises.Noise, rate_hz: float, seed: int, *, start_ns: int | None = None
) -> Simulation:
    """Simulated IMU along the (first) true poses of a recording, on a regular clock.

    Samples cover every trusted stretch. Stamps are whole periods after the first pose, on the poses' clock. Samples that an
    effect of the clock takes outside a stretch are left out. The true poses in a stretch are copied as they are;
    `/motion/pose` holds the motion itself. Effects count time from `start_ns`; see `taken`.

    Raises:
        ConfigError: the rate or the seed.
        DataError: no poses, less than 2 s of the motion can be trusted, an effect lacks a channel.
    """
    _check(rate_hz, seed)
    motion = smooth_motion(source.truth)
    if motion.duration_s < MIN_S:
        raise DataError(
            f"{motion.duration_s:.2f} s of the motion can be trusted",
            expected=f"{MIN_S:g} s of poses without a hole, and more",
            fix="Give a longer trajectory",
        )
    ideals = motion.ideal_motions(rate_hz * max(1, int(np.ceil(MOTION_HZ / rate_hz))))
    if needed := needs_channels(acting):
        ideals = [replace(ideal, channels=channels_at(source, ideal.t_s, motion.start_ns)) for ideal in ideals]
    stamps = [even_stamps(ideal, rate_hz) for ideal in ideals]
    started_s = None if start_ns is None else (start_ns - motion.start_ns) * 1e-9
    out = taken(ideals, stamps, [*acting, (additive_noise(noise, rate_hz, seed), np.zeros(0))], started_s)
    inside = motion.covers(source.truth.t_ns)
    return Simulation(
        Recording(
            name=source.name,
            imu=Imu(_nanoseconds(motion, out.stamp_s), out.gyro, out.accel),
            truths={TRUTH_TOPIC: source.truth.rows(inside), MOTION_TOPIC: _exact(motion, ideals, stamps)},
            scalars=dict(source.scalars) if needed else {},
            source=source.source,
        ),
        motion,
        tuple((part.start_s, part.end_s) for part in motion.stretches),
        {"rate_hz": rate_hz, "seed": seed},
        (*_of_poses(motion, source.truth, ideals, 1.0 - len(out.stamp_s) / sum(map(len, stamps))), *of_noise(noise, rate_hz)),
    )


def _check(rate_hz: float | None, seed: int) -> None:
    if rate_hz is not None and not SLOWEST_HZ <= rate_hz <= FASTEST_HZ:
        raise ConfigError(f"a rate of {rate_hz:g} Hz", where="rate_hz", expected=f"{SLOWEST_HZ:g} to {FASTEST_HZ:g} Hz")
    if seed < 0:
        raise ConfigError(f"seed {seed} is negative", where="seed", expected="0 or more")


def taken(
    ideals: Sequence[IdealMotion], stamps: Sequence[Float64[np.ndarray, " _"]], acting: Acting, started_s: float | None
) -> SensorSamples:
    """Samples of a sensor at some stamps.

    Its effects count time from `started_s`, or from the first sample if the two lie further apart than the motion lasts, so
    that it is another one.
    """
    first_s = float(stamps[0][0])
    began_s = first_s if started_s is None or abs(started_s - first_s) >= stamps[-1][-1] - first_s else started_s
    since = [replace(ideal, t_s=ideal.t_s - began_s) for ideal in ideals]
    out = simulate_stretches(since, [part - began_s for part in stamps], acting)
    return replace(out, stamp_s=out.stamp_s + began_s)


def even_stamps(ideal: IdealMotion, rate_hz: float) -> Float64[np.ndarray, " m"]:
    """Stamps of whole periods since the first pose, within a stretch."""
    first, last = np.ceil(ideal.t_s[0] * rate_hz - 1e-6), np.floor(ideal.t_s[-1] * rate_hz + 1e-6)
    return np.asarray(np.arange(first, last + 1.0) / rate_hz)


def _exact(motion: SmoothMotion, ideals: Sequence[IdealMotion], stamps: Sequence[Float64[np.ndarray, " _"]]) -> Poses:
    """Poses of the motion at the samples, with velocity."""
    parts = []
    for stretch in motion.stretches:
        own = [s for s, ideal in zip(stamps, ideals, strict=True) if stretch.start_s <= ideal.t_s[0] <= stretch.end_s]
        parts += [stretch.trajectory.poses(_nanoseconds(motion, stamp_s)) for stamp_s in own]
    return Poses(
        np.concatenate([part.t_ns for part in parts]),
        np.concatenate([part.p_wb for part in parts]),
        np.concatenate([part.q_wb_wxyz for part in parts]),
        np.concatenate([part.v_w for part in parts if part.v_w is not None]),
    )


def _nanoseconds(motion: SmoothMotion, stamp_s: Float64[np.ndarray, " m"]) -> Int64[np.ndarray, " m"]:
    return np.asarray(motion.start_ns + np.round(stamp_s * 1e9).astype(np.int64))


def _of_poses(motion: SmoothMotion, poses: Poses, ideals: Sequence[IdealMotion], lost: float) -> Iterator[str]:
    if lost > 0.05:
        yield f"{100.0 * lost:.0f} % of the samples are left out: the clock takes them outside the motion"
    if (left_out := poses.duration_s - motion.duration_s) > 0.05 * poses.duration_s:
        yield f"{left_out:.1f} s of {poses.duration_s:.1f} s are left out: holes and glitches of the poses, and their ends"
    force = float(median(np.concatenate([quaternion.length(ideal.accel) for ideal in ideals])))
    if force > MAX_M_S2:
        yield f"the motion has a specific force of {force:.3g} m/s² in the median; are its positions in metres?"


def of_noise(noise: noises.Noise, rate_hz: float) -> Iterator[str]:
    """Remarks on what of a noise is not simulated."""
    if noise.colour is not None and not noise.colour.holds_at(rate_hz):
        yield f"the colour of the noise is that of {noise.colour.rate_hz:g} Hz, and not simulated at {rate_hz:g} Hz"
    if lacking := ", ".join(name for name in noises.unknown(noise) if "instability" not in name):
        yield f"{lacking} not known in the noise file, and not simulated"


def _rounded(rate_hz: float) -> float:
    """Measured rate, rounded where that changes it by less than 0.1 %: 200.0016 Hz is 200."""
    whole = round(rate_hz)
    return float(whole) if whole and abs(rate_hz / whole - 1.0) < 1e-3 else rate_hz


def _source(path: Path, truth: str | None, *, channels: bool) -> Recording:
    """Recording of a log with poses; without an IMU, an empty one stands in."""
    with Log(path) as log:
        imus = log.imu_topics
        if not imus:
            return _without_imu(log, truth)
    found = read_log(path, imu=imus[0], truth=truth)
    found = with_channels(found, path).recording if channels else found
    if not found.truths:
        raise LogError("the log has no poses", where=path, expected="a topic of PoseStamped, Odometry or TF")
    return found if truth is None else found.with_truth(next(iter(found.truths)))


def _without_imu(log: Log, truth: str | None) -> Recording:
    """Poses of a topic, the first or `truth`; of transforms TOPIC/CHILD_FRAME or the only child."""
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
        raise LogError(f"{len(frames)} bodies on {name}", where=log.path, expected="one", fix=f"Choose `truth` out of {listed}")
    (parts,) = frames.values()
    t_ns, p_wb, q_wb_wxyz = (np.concatenate([part[k] for part in parts]) for k in (3, 4, 5))
    with log.named(topic):
        poses = Poses(t_ns, p_wb, unit_quaternions(q_wb_wxyz))
    none = Imu(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
    return Recording(name=log.path.stem, imu=none, truths={name: poses})
