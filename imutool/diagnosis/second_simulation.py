"""Simulation along the samples of another one, and the second simulation with found physics.

A simulator's IMU often sits elsewhere than its poses, or has physics of its own. What is found is the difference to its
samples, so a simulation along its poses alone would lose what the first one has. Its samples then are the ideal signals.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
from scipy.interpolate import make_interp_spline

from imutool.array_types import Bool, Float64, Rows6
from imutool.diagnosis.audit.simulation import imu_in, read_simulation
from imutool.diagnosis.diagnose import read_log
from imutool.diagnosis.estimation.aligned_log import DEFAULT
from imutool.diagnosis.estimation.time_alignment import MIN_NOISE, same_motion, with_simulation
from imutool.diagnosis.settings import DiagnoseSettings
from imutool.errors import ImutoolError
from imutool.file_location import Location
from imutool.inertial.stationary import white_noise
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read
from imutool.noise.datasheet import Noise
from imutool.recording import Imu, Recording, nanoseconds, seconds
from imutool.sensor import physics_file
from imutool.sensor.channels import needs_channels, with_channels
from imutool.sensor.physics_file_terms import SimulatedSensor, additive_noise
from imutool.sensor.simulate import MIN_S, Simulation, even_stamps, of_noise, simulate, simulated, taken

OF_NOISE = 1.5  # times a simulation's own noise, by which an ideal sensor along its poses may differ from its samples


def simulate_again(
    real: Location, sim: Path, out: Path, *, physics: Path, imu: str | None, settings: DiagnoseSettings, overwrite: bool
) -> None:
    """Simulate with some physics along a simulation's poses, or along its samples.

    The poses count if an ideal sensor along them reads the samples. An effect of a channel (a temperature) follows that of
    the recording `real`, if it is of the same motion.

    Raises:
        ConfigError: the target exists.
        DataError: an effect lacks a channel.
    """
    topic, along = imu_in(sim, imu), None
    needs = needs_channels(physics_file.read(physics).acting(where=physics))
    if needs or not _is_ideal(read(sim, imu=topic)):  # poses as `simulate` takes them
        with Log(real) as log:
            recording = read_log(real, imu=imu or log.imu_topics[0])
        along = partial(along_samples, imu=topic, beside=with_channels(recording, real).recording, settings=settings)
    simulate(sim, out, physics=physics, overwrite=overwrite, along=along)


def along_samples(
    sim: Path,
    truth: str | None,
    sensor: SimulatedSensor,
    *,
    imu: str | None,
    beside: Recording | None = None,
    settings: DiagnoseSettings = DEFAULT,
) -> Simulation:
    """Simulation whose samples, without their white noise, are the ideal signals of a sensor.

    The recording `beside`, of the same motion, shows more of the samples' noise, and has the channels.

    Raises:
        ConfigError, LogError: the log cannot be read, or has no such IMU.
        DataError: the samples last for less than 2 s, or an effect lacks a channel.
    """
    found, _ = read_simulation(sim, imu=imu, truth=truth)  # of the sensor, in a world whose z is up
    alone = beside is None or not same_motion(beside.imu, found.imu, settings.alignment)
    if beside is None or alone:
        beside = with_channels(found, sim).recording if needs_channels(sensor.acting) else found
    short = msgspec.structs.replace(settings, alignment=msgspec.structs.replace(settings.alignment, min_s=MIN_S))
    pairs = with_simulation(beside, found, short, own_poses=alone)
    ideals, clock_ns = [pair.ideal for pair in pairs], int(beside.imu.t_ns[0])
    sim_ns = clock_ns + nanoseconds(pairs[0].aligned_s)
    own_s = seconds(found.imu.t_ns, sim_ns)
    stamps = [
        even_stamps(x, sensor.rate_hz) if sensor.rate_hz else own_s[(own_s >= x.t_s[0]) & (own_s <= x.t_s[-1])] for x in ideals
    ]
    rate_hz = sensor.rate_hz or 1.0 / found.imu.period_s
    started_s = None if sensor.start_ns is None else (sensor.start_ns - clock_ns) * 1e-9
    noise = additive_noise(sensor.noise, rate_hz, sensor.seed)
    out = taken(ideals, stamps, [*sensor.acting, (noise, np.zeros(0))], started_s)
    t_ns = sim_ns + np.round(out.stamp_s * 1e9).astype(np.int64)
    return Simulation(
        replace(found, imu=Imu(t_ns, out.gyro, out.accel), scalars={}, frames={}),
        None,
        tuple((float(x.t_s[0] - ideals[0].t_s[0]), float(x.t_s[-1] - ideals[0].t_s[0])) for x in ideals),
        {"truth": next(iter(found.truths), None), "imu": found.imu_topic, "rate_hz": rate_hz, "seed": sensor.seed},
        tuple(of_noise(sensor.noise, rate_hz)),
    )


def _is_ideal(sim: Recording) -> bool:
    """Whether an ideal sensor along the poses of a simulation reads its samples, but for a constant and noise."""
    if not sim.truths:
        return False
    try:
        along = simulated(sim, (), Noise(), 1.0 / sim.imu.period_s, 0).recording.imu
    except ImutoolError:
        return False
    samples, (inside, ideal) = _columns(sim.imu), _at(along, sim.imu)
    off = samples[inside] - ideal
    return bool((off.std(axis=0) < OF_NOISE * np.maximum(white_noise(samples), MIN_NOISE)).all())


def _at(imu: Imu, stamps: Imu) -> tuple[Bool[np.ndarray, " n"], Float64[np.ndarray, "m 6"]]:
    """Samples of an IMU at the stamps of another that it covers."""
    start_ns = int(imu.t_ns[0])
    t_s, at_s = seconds(imu.t_ns, start_ns), seconds(stamps.t_ns, start_ns)
    inside = (at_s >= 0.0) & (at_s <= t_s[-1])
    return inside, np.asarray(make_interp_spline(t_s, _columns(imu), k=3)(at_s[inside]))


def _columns(imu: Imu) -> Rows6:
    return np.concatenate([imu.gyro, imu.accel], axis=1)
