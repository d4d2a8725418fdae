"""Size of the accelerometer: each of its axes has a lever arm of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from imutool.sensor.effect import Effect, Stage, Theta, each_pair
from imutool.sensor.readings import IdealMotion


def levers(felt: IdealMotion, r_b: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "n 3"]:
    """What axis i feels more at `r_b[i]` than at the tracked point: component i of alpha x r_i + omega x (omega x r_i) (m/s²).

    The double product is omega (omega . r) - |omega|² r; its parts that axis i sees come together in one product each.
    """
    x_r = np.zeros((3, 3))  # alpha @ x_r: (alpha x r_i)_i = alpha_j r_ik - alpha_k r_ij
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        x_r[j, i], x_r[k, i] = r_b[i, k], -r_b[i, j]
    size = np.einsum("na,na->n", felt.gyro, felt.gyro)
    along: Float64[np.ndarray, "n 3"] = felt.gyro @ r_b.T
    along *= felt.gyro
    along += felt.alpha @ x_r
    along -= size[:, None] * np.diag(r_b)
    return along


def _forward(felt: IdealMotion, r_b: Theta) -> IdealMotion:
    return replace(felt, accel=felt.accel + levers(felt, r_b.reshape(3, 3)))


EFFECT = Effect(
    "size_effect",
    Stage.MOTION,
    ("accel",),
    "accel_i += (alpha x r_i + omega x (omega x r_i))_i",
    each_pair("m", 0.02),
    "it turns fast; what the three arms share is a lever arm",
    _forward,
)
