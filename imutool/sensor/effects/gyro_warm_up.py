"""Warm-up of the gyro: + sum of A_k z_k, dz_k/dt = (1 - z_k) / tau_k.

`gyro_bias_drift` has one time constant, which a linear fit cannot find. Here three are given, and their sum imitates any
time constant between them.
"""

from __future__ import annotations

import numpy as np

from imutool.sensor.effect import Effect, Parameter, Stage, Theta
from imutool.sensor.samples import SensorSamples
from imutool.sensor.signals import LOAD_TAU_S, ON
from imutool.units import AXES


def load_drift(name: str, loads: slice, of: tuple[str, ...], equation: str, observable_if: str) -> Effect:
    """Drift of the gyro's bias behind some of the sensor's loads (`imutool.sensor.signals`)."""

    def forward(samples: SensorSamples, theta: Theta) -> SensorSamples:
        K = theta.reshape(3, len(LOAD_TAU_S), len(of))
        return samples.with_added("gyro", np.einsum("nkl,ikl->ni", samples.load[:, :, loads], K))

    parameters = tuple(
        Parameter(f"{axis}_{load}{tau_s:g}s", "rad/s", 0.01) for axis in AXES for tau_s in LOAD_TAU_S for load in of
    )
    return Effect(name, Stage.SENSOR, ("gyro",), equation, parameters, observable_if, forward, trained=True, diagnosed=False)


EFFECT = load_drift(
    "gyro_warm_up",
    slice(ON, ON + 1),
    ("",),
    "gyro += sum_k A_k z_k, dz_k/dt = (1 - z_k) / tau_k",
    "the log begins with a cold sensor",
)
