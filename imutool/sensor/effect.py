"""The forward side of an effect: what it makes of the ideal signals, in the order in which they meet it.

A file of an effect names it `EFFECT`. Its `forward` takes ideal signals and parameters and gives what comes out; nothing else
is needed to simulate it, and the estimator differentiates it by differences. Effects act in the order of their `stage`:

| stage | acts on | effects |
|---|---|---|
| MOTION | `IdealMotion` | what the point where the sensor sits feels: gravity, earth_rotation, lever_arm, size_effect,
vibration |
| MOUNT | `IdealMotion` | how the sensor sits: mount_resonance, mount_rotation |
| BANDWIDTH | `IdealMotion` | what it is too slow for: low_pass |
| CLOCK | times | when samples are taken: clock_offset, clock_skew, clock_jump |
| SENSOR | `SensorSamples` | scale, misalignment, nonlinearity, g-sensitivity, temperature, drift, bias |
| CONVERTER | `SensorSamples` | saturation, then quantization |
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64

from imutool.errors import DataError
from imutool.sensor.readings import IdealMotion, SensorSamples, Times
from imutool.units import AXES

Kind = Literal["catalogue", "driven", "unknown"]
Theta = Float64[np.ndarray, "_"]  # effects that act together have numbers of their own, so this length binds no other


class Stage(IntEnum):
    """When an effect acts."""

    MOTION = 0
    MOUNT = 1
    BANDWIDTH = 2
    CLOCK = 3
    SENSOR = 4
    CONVERTER = 5


@dataclass(frozen=True)
class Parameter:
    """A parameter: name, unit, plausible size (one standard deviation of what is met), whether it is positive by nature.

    `null_value` is the value at which the effect does nothing: 0, or infinity (a cut-off frequency, a limit). A number that
    matters only beside an amplitude (a time constant, a frequency) has its plausible size there: any value would do.
    `step`, where given, is the largest one whose difference is still a derivative, of the logarithm if `positive`. `begins`: it
    is the time (s from the log's start) at which the effect sets in, never if infinite; nothing is smooth in it, so all times
    are gone through.
    """

    name: str
    unit: str
    plausible: float
    positive: bool = False
    null_value: float = 0.0
    step: float | None = None
    begins: bool = False


@dataclass(frozen=True)
class Effect:
    """An effect as it acts.

    forward: (Felt, theta) -> Felt up to BANDWIDTH; (taken_s, theta) -> taken_s at CLOCK; (Read, theta) -> Read after.
    linear: whether what it adds is proportional to theta (then a fit may start at zero).
    starts: for the others, values of theta to start a fit from, given the ideal signals and the samples: at least one, all
        finite, and positive where a number is (a limit that is not reached instead of none).
    alternatives: out of how many the starts are the best, given the samples; so many times likelier does chance look like one.
    needs: channels without which it cannot be thought of, such as "temperature"; a channel whose name contains it serves.
    kind: of the catalogue, driven by the channel `variable`, or unknown: a curve of `variable`, or a term, on one `axis`.
    variant: tells effects of one name apart.
    jumps: whether what comes out is no smooth function of the parameters, which is an edge between two samples.
    """

    name: str
    stage: Stage
    sensors: tuple[str, ...]
    equation: str
    parameters: tuple[Parameter, ...]
    seen_if: str
    forward: Callable[[Any, Theta], Any]
    linear: bool = True
    starts: Callable[[Any, Any], Sequence[Theta]] | None = None
    alternatives: Callable[[SensorSamples], int] | None = None
    needs: tuple[str, ...] = ()
    kind: Kind = "catalogue"
    variable: str = ""
    axis: int | None = None
    variant: str = ""
    jumps: bool = False

    @property
    def key(self) -> str:
        """Name and variant, which identify an effect among candidates."""
        return f"{self.name}:{self.variant}" if self.variant else self.name

    @property
    def plausible(self) -> Theta:
        """The plausible size of each parameter."""
        return np.array([number.plausible for number in self.parameters])

    @property
    def null_value(self) -> Theta:
        """The parameters at which it does nothing."""
        return np.array([number.null_value for number in self.parameters])


def each_axis(unit: str, plausible: float, before: str = "") -> tuple[Parameter, ...]:
    """One number for each axis, its name perhaps with a word before."""
    return tuple(Parameter(before + axis, unit, plausible) for axis in AXES)


def each_pair(unit: str, plausible: float, *, diagonal: bool = True, before: str = "") -> tuple[Parameter, ...]:
    """One number for each entry of a 3x3 matrix, row by row: `xy` is what y adds to x."""
    return tuple(Parameter(before + a + b, unit, plausible) for a in AXES for b in AXES if diagonal or a != b)


def matrix(theta: Float64[np.ndarray, "6"]) -> Float64[np.ndarray, "3 3"]:
    """The matrix whose entries off the diagonal are these, row by row; the diagonal is zero."""
    out = np.zeros((3, 3))
    out[~np.eye(3, dtype=bool)] = theta
    return out


def attitude(felt: IdealMotion, effect: str) -> Float64[np.ndarray, "n 3 3"]:
    """R_wb, for an effect that needs it.

    Raises:
        DataError: it is not known.
    """
    if felt.R_wb is None:
        raise DataError("the attitude is not known", where=effect, expected="a motion with orientations")
    return felt.R_wb


def misfit(felt: IdealMotion, samples: SensorSamples) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]:
    """Samples minus the ideal at the same stamps: gyro (rad/s), accel (m/s²). Good enough to start a fit from."""
    ideal = felt.taken(samples.stamp_s, samples.stamp_s)
    return samples.gyro - ideal.gyro, samples.accel - ideal.accel


WITHIN_STAGE = {"gain": -2, "dead_band": -1, "saturation": 1, "quantization": 2}
Acting = Sequence[tuple[Effect, Theta]]


@dataclass(frozen=True, eq=False)
class SignalState:
    """How far signals have come: what is felt and when samples are taken of it, or, behind the clock, what is read."""

    felt: Any  # an `IdealMotion`, or any other signal that can be sampled
    taken_s: Times
    stamp_s: Times
    taken: Any = None

    def through(self, physics: Effect, theta: Theta) -> SignalState:
        """Behind one more effect, whose turn it is."""
        if physics.stage < Stage.CLOCK:
            return SignalState(physics.forward(self.felt, theta), self.taken_s, self.stamp_s)
        if physics.stage == Stage.CLOCK:
            return SignalState(self.felt, physics.forward(self.taken_s, theta), self.stamp_s)
        return SignalState(self.felt, self.taken_s, self.stamp_s, physics.forward(self.arrived(), theta))

    def taking(self) -> SignalState:
        """With the samples taken: behind this, the clock and what is felt do not matter any more."""
        return self if self.taken is not None else SignalState(self.felt, self.taken_s, self.stamp_s, self.arrived())

    def arrived(self) -> SensorSamples:
        """One row a sample."""
        return self.felt.taken(self.taken_s, self.stamp_s) if self.taken is None else self.taken


def read(felt: IdealMotion, stamp_s: Times, acting: Acting) -> SensorSamples:
    """What a sensor with these effects reads at some stamps: the stages one after another, within a stage by name."""
    way = SignalState(felt, np.asarray(stamp_s, dtype=np.float64), stamp_s)
    for physics, theta in in_stage_order(acting):
        way = way.through(physics, theta)
    return way.arrived()


def sensed(taken: SensorSamples, acting: Acting) -> SensorSamples:
    """What a sensor makes of samples that are taken: the stages behind CLOCK alone."""
    for physics, theta in in_stage_order(acting):
        if physics.stage > Stage.CLOCK:
            taken = physics.forward(taken, theta)
    return taken


def in_stage_order(acting: Acting) -> list[tuple[Effect, Theta]]:
    """As they act."""
    return sorted(acting, key=lambda pair: stage_order(pair[0]))


def stage_order(physics: Effect) -> tuple[int, int, str]:
    """By which it is told when an effect acts."""
    return physics.stage, WITHIN_STAGE.get(physics.name, 0), physics.key
