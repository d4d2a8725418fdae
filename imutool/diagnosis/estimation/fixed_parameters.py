"""An effect with some of its parameters held at nothing, because no motion shows them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from imutool.sensor.effect import Effect, Theta

IMPLAUSIBLE = 4.0  # times the plausible size


class FixedParameters:
    """The forward model of the others."""

    def __init__(self, physics: Effect, free: Sequence[int]) -> None:
        self.physics, self.free = physics, list(free)

    def __call__(self, signals: Any, theta: Theta) -> Any:
        """As the whole effect, with nothing for what is held."""
        every = self.physics.null_value.astype(float)
        every[self.free] = theta
        return self.physics.forward(signals, every)


def with_free(physics: Effect, free: Sequence[int]) -> Effect:
    """The effect with these of its parameters, by place; itself where they are all."""
    if len(free) == len(physics.parameters):
        return physics
    return replace(physics, parameters=tuple(physics.parameters[k] for k in free), forward=FixedParameters(physics, free))


def without_implausible(physics: Effect, theta: Theta) -> Effect:
    """Itself, or without the parameters that came out many times larger than anything met: a fit to noise, not a number."""
    if not physics.linear or physics.kind != "catalogue":
        return physics
    free = [k for k, (n, v) in enumerate(zip(physics.parameters, theta, strict=True)) if abs(v) <= IMPLAUSIBLE * n.plausible]
    if len(free) == len(theta):
        return physics
    return with_free(physics, free)


def values_of(physics: Effect, held: Effect, theta: Theta) -> Theta:
    """The values of the parameters that are left."""
    names = [number.name for number in held.parameters]
    return np.array([value for number, value in zip(physics.parameters, theta, strict=True) if number.name in names])
