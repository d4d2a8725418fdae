"""Second simulation with found physics, along the first one's poses or samples.

A simulator's IMU often sits elsewhere than its poses, or has physics of its own. What is found is the difference to its
samples, so a simulation along its poses alone would lose what the first one has. Its samples then are the ideal signals.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.interpolate import make_interp_spline

from imutool.array_types import Bool, Float64
from imutool.diagnosis.audit.simulation import imu_in, read_simulation
from imutool.diagnosis.diagnose import read_log
from imutool.diagnosis.estimation.time_alignment import LEAST_NOISE, same_motion, with_simulation
from imutool.diagnosis.settings import DiagnoseSettings
from imutool.errors import ImutoolError
from imutool.file_location import Location
from imutool.inertial.stationary import white_noise
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read
from imutool.mcap_io.write import write
from imutool.noise.datasheet import Noise
from imutool.recording import Imu, Recording, nanoseconds, seconds
from imutool.sensor import physics_file
from imutool.sensor.channels import with_channels
from imutool.sensor.effect import simulate_stretches
from imutool.sensor.physics_file import PhysicsFile
from imutool.sensor.simulate import needs_channels, simulate, simulated

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
    file = physics_file.read(physics)
    topic = imu_in(sim, imu)
    if not needs_channels(file.acting(where=physics)) and _is_ideal(read(sim, imu=topic)):  # poses as `simulate` takes them
        simulate(sim, out, physics=physics, overwrite=overwrite)
        return
    simulation, _ = read_simulation(sim, imu=topic)  # of the sensor, in a world whose z is up
    with Log(real) as log:
        recording = read_log(real, imu=imu or log.imu_topics[0])
    if same_motion(recording.imu, simulation.imu, settings.alignment):
        recording = with_channels(recording, real).recording
    else:
        recording = with_channels(simulation, sim).recording
    about = {"command": "diagnose", "simulation": sim.name, "physics": json.dumps(physics_file.plain(file), ensure_ascii=False)}
    again = _along_samples(simulation, recording, file, settings)
    metadata = {**simulation.metadata, "imutool": about}
    write(replace(again, name=out.stem, metadata=metadata), out, overwrite=overwrite)


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
    return bool((off.std(axis=0) < OF_NOISE * np.maximum(white_noise(samples), LEAST_NOISE)).all())


def _at(imu: Imu, stamps: Imu) -> tuple[Bool[np.ndarray, " n"], Float64[np.ndarray, "m 6"]]:
    """Samples of an IMU at the stamps of another that it covers."""
    start_ns = int(imu.t_ns[0])
    t_s, at_s = seconds(imu.t_ns, start_ns), seconds(stamps.t_ns, start_ns)
    inside = (at_s >= 0.0) & (at_s <= t_s[-1])
    return inside, np.asarray(make_interp_spline(t_s, _columns(imu), k=3)(at_s[inside]))


def _columns(imu: Imu) -> Float64[np.ndarray, "n 6"]:
    return np.concatenate([imu.gyro, imu.accel], axis=1)


def _along_samples(sim: Recording, real: Recording, physics: PhysicsFile, settings: DiagnoseSettings) -> Recording:
    """Simulation whose own samples, without their noise, are the ideal signals of a sensor with some physics."""
    pairs = with_simulation(real, sim, settings)
    stamp_s = seconds(sim.imu.t_ns, int(real.imu.t_ns[0]) + nanoseconds(pairs[0].aligned_s))
    ideals = [pair.ideal for pair in pairs]
    stamps = [stamp_s[(stamp_s >= ideal.t_s[0]) & (stamp_s <= ideal.t_s[-1])] for ideal in ideals]
    out = simulate_stretches(ideals, stamps, physics.acting())
    rows = np.searchsorted(stamp_s, out.stamp_s)
    return replace(sim, imu=Imu(sim.imu.t_ns[rows], out.gyro, out.accel), scalars={}, frames={})
