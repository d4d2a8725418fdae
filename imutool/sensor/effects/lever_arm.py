"""Lever arm of the accelerometer, from the tracked point: + alpha x r + omega x (omega x r)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from imutool.array_types import Vectors
from imutool.inertial.kinematics import lever_acceleration
from imutool.sensor.effect import CompiledEffect, Effect, Stage, Theta, each_axis
from imutool.sensor.samples import IdealMotion
from imutool.sensor.signals import ALPHA, GYRO, Signals
from imutool.units import Three

MAX_M = 30.0  # no tolerance of a sensor: on a truck, a ship or an aircraft it sits metres from the tracked point


def _forward(motion: IdealMotion, r_b: Theta) -> IdealMotion:
    added = lever_acceleration(motion.gyro.T, motion.alpha.T, (r_b, r_b, r_b))
    return replace(motion, accel=motion.accel + np.stack(added).T)


def _fast(r_b: Theta) -> CompiledEffect:
    """The same law on columns, and on plain floats."""
    r = tuple(r_b.tolist())
    arms = (r, r, r)

    def block(signals: Signals) -> Vectors:
        return np.stack(lever_acceleration(signals.gyro.T, signals.alpha.T, arms), axis=1)

    def one(_: float, row: list[float]) -> Three:
        return lever_acceleration(row[GYRO], row[ALPHA], arms)

    return CompiledEffect(block, one)


EFFECT = Effect(
    "lever_arm",
    Stage.MOTION,
    ("accel",),
    "accel += alpha x r + omega x (omega x r)",
    tuple(replace(arm, maximum=MAX_M) for arm in each_axis("m", 0.3)),
    "it turns; the part along a single turning axis is not seen",
    _forward,
    trained=True,
    fast=_fast,
)
