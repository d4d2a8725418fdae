"""The forward side of an effect: what it makes of the ideal signals, in the order in which they meet it.

A file of an effect names it `PHYSICS`. Its `forward` takes ideal signals and parameters and gives what comes out; nothing else
is needed to simulate it, and the estimator differentiates it by differences. Effects act in the order of their `stage`:

| stage | acts on | effects |
|---|---|---|
| MOTION | `Felt` | what the point where the sensor sits feels: gravity, earth_rotation, lever_arm, size_effect, vibration |
| MOUNT | `Felt` | how the sensor sits: mount_resonance, mount_rotation |
| BANDWIDTH | `Felt` | what it is too slow for: low_pass |
| CLOCK | times | when samples are taken: clock_offset, clock_skew, clock_jump |
| SENSOR | `Read` | scale, misalignment, nonlinearity, g-sensitivity, temperature, drift, bias |
| CONVERTER | `Read` | saturation, then quantization |
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from jaxtyping import Float64

from imutool.physics.effects._base import Sensor
from imutool.physics.readings import Felt, Read, Times

Theta = Float64[np.ndarray, " p"]


class Stage(IntEnum):
    """When an effect acts."""

    MOTION = 0
    MOUNT = 1
    BANDWIDTH = 2
    CLOCK = 3
    SENSOR = 4
    CONVERTER = 5


@dataclass(frozen=True)
class Number:
    """A parameter: name, unit, plausible size (one standard deviation of what is met), whether it is positive by nature.

    `nothing` is the value at which the effect does nothing: 0, or infinity (a cut-off frequency, a limit).
    """

    name: str
    unit: str
    plausible: float
    positive: bool = False
    nothing: float = 0.0


@dataclass(frozen=True)
class Physics:
    """An effect as it acts.

    forward: (Felt, theta) -> Felt up to BANDWIDTH; (taken_s, theta) -> taken_s at CLOCK; (Read, theta) -> Read after.
    linear: whether what it adds is proportional to theta (then a fit may start at zero).
    starts: for the others, values of theta to start a fit from, given the ideal signals and the samples.
    needs: channels without which it cannot be thought of, such as "temperature"; a channel whose name contains it serves.
    """

    name: str
    stage: Stage
    sensors: tuple[Sensor, ...]
    equation: str
    parameters: tuple[Number, ...]
    seen_if: str
    forward: Callable[[Any, Theta], Any]
    linear: bool = True
    starts: Callable[[Felt, Read], Sequence[Theta]] | None = None
    needs: tuple[str, ...] = ()

    @property
    def plausible(self) -> Theta:
        """The plausible size of each parameter."""
        return np.array([number.plausible for number in self.parameters])

    @property
    def nothing(self) -> Theta:
        """The parameters at which it does nothing."""
        return np.array([number.nothing for number in self.parameters])


CONVERTER_ORDER = {"saturation": 1, "quantization": 2}
Acting = Sequence[tuple[Physics, Theta]]


def read(felt: Felt, stamp_s: Times, acting: Acting) -> Read:
    """What a sensor with these effects reads at some stamps: the stages one after another, within a stage by name."""
    order = sorted(acting, key=lambda pair: (pair[0].stage, CONVERTER_ORDER.get(pair[0].name, 0), pair[0].name))
    taken_s = np.asarray(stamp_s, dtype=np.float64)
    for physics, theta in order:
        if physics.stage < Stage.CLOCK:
            felt = physics.forward(felt, theta)
        elif physics.stage == Stage.CLOCK:
            taken_s = physics.forward(taken_s, theta)
    out = felt.taken(taken_s, stamp_s)
    for physics, theta in order:
        if physics.stage > Stage.CLOCK:
            out = physics.forward(out, theta)
    return out
