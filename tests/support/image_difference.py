"""A made-up flight whose curves lie so far apart that each can be seen: raw is far off, a model a fifth of that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from imutool.recording import Imu, Recording, Scalars
from imutool.sensor.made_up_flight import ACCEL_BIAS, GYRO_BIAS, flight
from imutool.viewing.model.run_data import Run

OFF = np.array([-0.08, -0.12, 0.18, 1.2, -1.8, 2.4])  # rad/s, m/s²: error of raw, added to the flight's bias (-0.05 in x)
NOISE = np.array([0.01, 0.01, 0.01, 0.1, 0.1, 0.1])  # rad/s, m/s²: of raw alone, so that its spectrum lies above
LEFT, SIGMA = 0.2, 0.1  # of that: what a model leaves, and what it says that it may be wrong by
DURATION_S = 8.0


def recording(seed: int = 3) -> Recording:
    """The flight, with truth of poses and biases."""
    made = flight(seed, duration_s=DURATION_S)
    imu = Imu(made.imu.t_ns, made.imu.gyro + OFF[:3], made.imu.accel + OFF[3:])
    true = {topic: made.scalars[topic] for topic in (GYRO_BIAS, ACCEL_BIAS)}
    moved = {
        topic: Scalars(bias.t_ns, bias.values + part, bias.unit)
        for (topic, bias), part in zip(true.items(), (OFF[:3], OFF[3:]), strict=True)
    }
    return replace(made, imu=imu, scalars={**made.scalars, **moved})


def runs(made: Recording, models: int = 1) -> list[Run]:
    """Raw, and models of which each further one leaves half as much again."""
    noise = np.random.default_rng(0).normal(0.0, NOISE, (len(made.imu), 6))
    raw = Imu(made.imu.t_ns, made.imu.gyro + noise[:, :3], made.imu.accel + noise[:, 3:])
    return [Run.raw(raw), *(model(made, f"model {k}", LEFT * 1.5**k) for k in range(models))]


def model(made: Recording, name: str, left: float) -> Run:
    """One that takes away all but a share of the bias."""
    gyro_bias, accel_bias = (
        made.scalars[topic].values - left * part
        for topic, part in zip((GYRO_BIAS, ACCEL_BIAS), (OFF[:3], OFF[3:]), strict=True)
    )
    imu = Imu(made.imu.t_ns, made.imu.gyro - gyro_bias, made.imu.accel - accel_bias)
    return Run(name, imu, gyro_bias, accel_bias, np.tile(SIGMA * np.abs(OFF), (len(imu), 1)))
