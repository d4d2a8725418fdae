"""Warm-up of the gyro: + A (1 - exp(-t/tau)), t from the log's start with a cold sensor."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from imutool.array_types import Float64
from imutool.sensor.effect import ONCE_MORE, Effect, Parameter, Remembered, Stage, Theta, each_axis, residual, starts_at
from imutool.sensor.samples import IdealMotion, SensorSamples
from imutool.units import Sensor

TRAINING_TAU_S = 60.0
START_TAU_S = (3.0, 10.0, 30.0, 100.0)
STEADY_TAU_S = 86400.0


def warm_up(sensor: Sensor, unit: str, plausible: float) -> Effect:
    """Warm-up of either sensor: A, then tau (s)."""
    relaxation_of = Remembered(_relaxation)

    def forward(samples: SensorSamples, theta: Theta) -> SensorSamples:
        return samples.with_added(sensor, np.outer(theta[:3], relaxation_of(samples.stamp_s, float(theta[3]))).T)

    def starts(motion: IdealMotion, samples: SensorSamples) -> list[Theta]:
        """Amplitudes by least squares, with a constant, for each tau."""
        error, found = residual(motion, samples)[0 if sensor == "gyro" else 1], []
        for tau_s in START_TAU_S:
            relaxation = _relaxation(samples.stamp_s, tau_s)
            columns = np.stack([relaxation, np.ones_like(relaxation)], axis=1)
            found.append(np.append(np.linalg.lstsq(columns, error, rcond=None)[0][0], tau_s))
        return found

    return Effect(
        f"{sensor}_bias_drift",
        Stage.SENSOR,
        (sensor,),
        f"{sensor} += A (1 - exp(-t/tau))",
        (
            *each_axis(unit, plausible),
            Parameter("tau", "s", 30.0, positive=True, null_value=30.0, fixed_in_training=TRAINING_TAU_S),
        ),
        "the log is longer than tau",
        forward,
        linear=False,
        starts=starts,
        trained=True,
        of_time=True,
        reached=partial(_reached, TRAINING_TAU_S),
    )


def within(effects: Sequence[Effect], end_s: float) -> Iterator[Effect]:
    """Effects in a log that ends then, with a second and a steady drift next to each warm-up.

    A warm-up is fitted by what the log reaches of it. Of a time constant far beyond the log only the slope shows, A / tau: tau
    is a day there, and as unsure as its prior.
    """
    for effect in effects:
        if effect.reached is None:
            yield effect
        else:
            reaching = replace(effect, reached=partial(_reached, end_s))
            second = replace(reaching, variant=ONCE_MORE[0], equation=f"{effect.equation} ({ONCE_MORE[0]})")
            yield from (reaching, second, _steady(effect, _reached(end_s, STEADY_TAU_S)))


def _steady(warming: Effect, share: float) -> Effect:
    *amplitudes, tau = warming.parameters
    sizes = (replace(amplitude, plausible=amplitude.plausible / share) for amplitude in amplitudes)
    return replace(
        warming,
        variant="steady",
        parameters=(*sizes, replace(tau, plausible=STEADY_TAU_S, null_value=STEADY_TAU_S)),
        forward=lambda samples, theta: warming.forward(samples, np.append(theta[:3], STEADY_TAU_S)),
        starts=starts_at([0.0, 0.0, 0.0, STEADY_TAU_S]),
        reached=None,
    )


def _reached(end_s: float, tau_s: float) -> float:
    return -float(np.expm1(-end_s / tau_s))


def _relaxation(stamp_s: Float64[np.ndarray, " n"], tau_s: float) -> Float64[np.ndarray, " n"]:
    return np.asarray(-np.expm1(-stamp_s / tau_s))


EFFECT = warm_up("gyro", "rad/s", 0.02)
