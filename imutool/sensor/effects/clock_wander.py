"""A clock that wanders: its offset is straight between knots in time.

A motion capture and a sensor have a clock each. Both are corrected now and then, so that their offset moves by milliseconds.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from imutool.sensor.effect import Effect, Parameter, Stage, Theta, starts_at
from imutool.sensor.samples import Times

KNOTS_S = (*range(0, 300, 30), *range(300, 601, 60))


def until(end_s: float) -> Effect:
    """The effect with the knots of a log that ends then; its last offset holds from there on."""
    return _effect(KNOTS_S[: sum(t_s < end_s for t_s in KNOTS_S) + 1])


def with_knots(effects: Sequence[Effect], end_s: float) -> list[Effect]:
    """Effects with the knots that a log has which ends then."""
    return [until(end_s) if effect.name == EFFECT.name else effect for effect in effects]


def _effect(knots_s: Sequence[int]) -> Effect:
    def forward(taken_s: Times, offsets_s: Theta) -> Times:
        return np.asarray(taken_s + np.interp(taken_s, knots_s, offsets_s))

    return Effect(
        "clock_wander",
        Stage.CLOCK,
        ("gyro", "accel"),
        "samples are taken at t + w(t)",
        tuple(Parameter(f"at_{t_s}", "s", 0.005) for t_s in knots_s),
        "it moves throughout",
        forward,
        linear=False,
        starts=starts_at([0.0] * len(knots_s)),
    )


EFFECT = _effect(KNOTS_S)
