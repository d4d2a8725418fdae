"""Lever arm of the accelerometer: + alpha x r + omega x (omega x r)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from imutool.sensor.effect import Effect, Stage, Theta, each_axis
from imutool.sensor.effects.size_effect import levers
from imutool.sensor.linear_effect import AtWork, LinearEffect, Three, per_axis
from imutool.sensor.readings import IdealMotion
from imutool.sensor.signals import ALPHA, GYRO, Signals
from imutool.units import Sensor

SENSORS: tuple[Sensor, ...] = ("accel",)
# columns of the terms: alpha_x, alpha_y, alpha_z, then the products of rates
PRODUCTS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def _terms(signals: Signals) -> Float64[np.ndarray, "n 9"]:
    w = signals.gyro
    return np.concatenate([signals.alpha, np.stack([w[:, a] * w[:, b] for a, b in PRODUCTS], axis=1)], axis=1)


def _pattern() -> Float64[np.ndarray, "3 9 3"]:
    """d (alpha x r + omega (omega . r) - |omega|² r)_i / d r_p, by term."""
    pattern = np.zeros((3, 9, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):  # (alpha x r)_i = alpha_j r_k - alpha_k r_j
        pattern[i, j, k], pattern[i, k, j] = 1.0, -1.0
    for q, (a, b) in enumerate(PRODUCTS, start=3):
        pattern[a, q, b] += 1.0
        if a != b:
            pattern[b, q, a] += 1.0
        else:
            pattern[:, q] -= np.eye(3)
    return pattern


def _at_work(r_b: Float64[np.ndarray, "3"]) -> AtWork:
    """alpha x r + omega (omega . r) - |omega|² r."""
    x, y, z = r_b.tolist()
    r_x = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])  # rows: alpha x r = -[r]x alpha = alpha [r]x

    def block(signals: Signals) -> Float64[np.ndarray, "n 3"]:
        w = signals.gyro
        along, size = (w @ r_b)[:, None], np.einsum("na,na->n", w, w)[:, None]
        return np.asarray(signals.alpha @ r_x + w * along - size * r_b)

    def one(_: float, row: list[float]) -> Three:
        (wx, wy, wz), (ax, ay, az) = row[GYRO], row[ALPHA]
        along, size = wx * x + wy * y + wz * z, wx * wx + wy * wy + wz * wz
        return (
            ay * z - az * y + wx * along - size * x,
            az * x - ax * z + wy * along - size * y,
            ax * y - ay * x + wz * along - size * z,
        )

    return AtWork(block, one)


def effect(sensor: Sensor) -> LinearEffect:
    """r (m): from the tracked point to the accelerometer; the part along a single turning axis is not seen."""
    equation = "accel += alpha x r + omega x (omega x r)"
    return LinearEffect("lever_arm", sensor, equation, per_axis("m", 0.3), _terms, _pattern(), _at_work)


def _forward(felt: IdealMotion, r_b: Theta) -> IdealMotion:
    return replace(felt, accel=felt.accel + levers(felt, np.tile(r_b, (3, 1))))


EFFECT = Effect(
    "lever_arm",
    Stage.MOTION,
    SENSORS,
    "accel += alpha x r + omega x (omega x r)",
    each_axis("m", 0.3),
    "it turns; the part along a single turning axis is not seen",
    _forward,
)
