"""An effect with some of its parameters held at nothing, because no motion shows them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from imutool.physics.effects._forward import Physics, Theta


class Held:
    """The forward model of the others."""

    def __init__(self, physics: Physics, free: Sequence[int]) -> None:
        self.physics, self.free = physics, list(free)

    def __call__(self, signals: Any, theta: Theta) -> Any:
        """As the whole effect, with nothing for what is held."""
        every = self.physics.nothing.astype(float)
        every[self.free] = theta
        return self.physics.forward(signals, every)


def only(physics: Physics, free: Sequence[int]) -> Physics:
    """The effect with these of its parameters, by place; itself where they are all."""
    if len(free) == len(physics.parameters):
        return physics
    return replace(physics, parameters=tuple(physics.parameters[k] for k in free), forward=Held(physics, free))
