"""Effect: equation, parameters and forward model of one deviation of a real sensor.

A file of `imutool/sensor/effects` holds one, by the name `EFFECT`. Its `forward` maps ideal signals and parameters to the
signals behind it. Nothing else is needed: simulation runs it, the diagnosis differentiates it by differences, and the linear
error of a bias model is derived from it (`imutool.sensor.linear_form`). Effects act in the order of their `stage`:

| stage | acts on | effects |
|---|---|---|
| MOTION | `IdealMotion` | motion where the sensor sits: gravity, earth_rotation, lever_arm, size_effect, vibration |
| MOUNT | `IdealMotion` | how the sensor is mounted: mount_resonance, mount_rotation |
| BANDWIDTH | `IdealMotion` | the sensor's own bandwidth: low_pass, second_order_low_pass, gyro_delay |
| CLOCK | times | when samples are taken: clock_offset, clock_skew, clock_jump, clock_wander |
| SENSOR | `SensorSamples` | scale, misalignment, nonlinearity, g-sensitivity, temperature, drift, bias |
| CONVERTER | `SensorSamples` | saturation, then quantization |
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any, Literal

import numpy as np

from imutool.array_types import Float64, Vectors
from imutool.errors import DataError
from imutool.sensor.samples import IdealMotion, SensorSamples, Times
from imutool.sensor.signals import Signals
from imutool.units import AXES, Three

Kind = Literal["catalogue", "driven", "unknown"]
ONCE_MORE = ("second", "third")  # variants of an effect that acts several times, each in addition to the one before
Theta = Float64[np.ndarray, "_"]  # effects that act together have parameters of their own, so this length binds no other


class Stage(IntEnum):
    """Stage at which an effect acts."""

    MOTION = 0
    MOUNT = 1
    BANDWIDTH = 2
    CLOCK = 3
    SENSOR = 4
    CONVERTER = 5


@dataclass(frozen=True)
class Parameter:
    """Parameter of an effect: name, unit, and plausible size as one standard deviation.

    positive: it is positive by nature, so that a fit moves its logarithm.
    null_value: the value at which the effect does nothing: 0, or infinity (a cut-off frequency, a limit). A parameter that
        matters only together with an amplitude (a time constant, a frequency) has its plausible size there.
    step: the largest step whose difference is still a derivative, of the logarithm if `positive`.
    begins: it is the time (s from the log's start) at which the effect sets in, never if infinite; a fit tries all times.
    minimum, maximum: smallest value and largest size that are an answer; without `maximum`, a few times the plausible size.
    fixed_in_training: the value that training gives a parameter in which the effect is not linear.
    """

    name: str
    unit: str
    plausible: float
    positive: bool = False
    null_value: float = 0.0
    step: float | None = None
    begins: bool = False
    minimum: float | None = None
    maximum: float | None = None
    fixed_in_training: float | None = None


@dataclass(frozen=True, slots=True)
class CompiledEffect:
    """Effect for given parameters: the error in a block, and at one sample by time and columns.

    One sample is plain floats: numpy's calls would cost several times the arithmetic.
    """

    block: Callable[[Signals], Vectors]
    one: Callable[[float, list[float]], Three]

    def __call__(self, signals: Signals) -> Vectors:
        """The error at each sample of a block."""
        return self.block(signals)


@dataclass(frozen=True)
class Effect:
    """An effect on a sensor: its equation, its parameters and its forward model.

    observable_if: what a log must have for the parameters to show, as the reference of the effects lists it.
    forward: (IdealMotion, theta) -> IdealMotion up to BANDWIDTH; (taken_s, theta) -> taken_s at CLOCK; (SensorSamples, theta)
        -> SensorSamples behind it.
    linear: whether what it adds is proportional to theta (then a fit may start at zero).
    starts: for the others, values of theta to start a fit from, given the ideal motion and the samples: at least one, all
        finite, and positive where a parameter is (a limit that is not reached instead of none).
    alternatives: out of how many the starts are the best, given the samples; so many times likelier does chance look like one.
    needs: channels that it cannot do without, such as "temperature"; a channel whose name contains it serves.
    kind: of the catalogue, driven by the channel `variable`, or unknown: a curve of `variable`, or a term, on one `axis`.
    variant: tells effects of one name apart; constants: parameters that no fit changes, which a finding states.
    jumps: what comes out is no smooth function of the parameters: an edge between two samples.
    trained: a bias model can have it: its error follows from the sensor's own samples and is linear in all parameters but those
        `fixed_in_training`.
    diagnosed: a diagnosis may find it.
    basis, fast: the terms of a trained effect, and it for given parameters, where `forward` would be slow; the same numbers.
    lagless: `forward` with its gain and without its lag.
    of_time: what it adds depends on time alone, as the walk of a bias does.
    reached: share of the amplitudes that shows in a log, by the last parameter, a time constant. A fit moves this share: of a
        time constant longer than the log only the slope shows, and any larger amplitude with a longer one gives the same.
    """

    name: str
    stage: Stage
    sensors: tuple[str, ...]  # gyro, accel, or the names of another signal's columns
    equation: str
    parameters: tuple[Parameter, ...]
    observable_if: str
    forward: Callable[[Any, Theta], Any]
    linear: bool = True
    starts: Callable[[Any, Any], Sequence[Theta]] | None = None
    alternatives: Callable[[SensorSamples], int] | None = None
    needs: tuple[str, ...] = ()
    kind: Kind = "catalogue"
    variable: str = ""
    axis: int | None = None
    variant: str = ""
    constants: tuple[tuple[Parameter, float], ...] = ()
    jumps: bool = False
    trained: bool = False
    diagnosed: bool = True
    basis: Callable[[Signals], Float64[np.ndarray, "n q"]] | None = None
    fast: Callable[[Theta], CompiledEffect] | None = None
    lagless: Callable[[Any, Theta], Any] | None = None
    of_time: bool = False
    reached: Callable[[float], float] | None = None

    @property
    def key(self) -> str:
        """Name and variant, which identify an effect among candidates."""
        return f"{self.name}:{self.variant}" if self.variant else self.name

    @property
    def plausible(self) -> Theta:
        """The plausible size of each parameter."""
        return np.array([parameter.plausible for parameter in self.parameters])

    @property
    def null_value(self) -> Theta:
        """The parameters at which the effect does nothing."""
        return np.array([parameter.null_value for parameter in self.parameters])

    def meets(self, other: Effect) -> bool:
        """Whether both act on a column in common; an effect that names none acts on all."""
        return not self.sensors or not other.sensors or bool({*self.sensors} & {*other.sensors})

    def without_lag(self, theta: Theta) -> Effect:
        """The effect at these parameters, which a fit no longer changes, and without its lag."""
        lagless = self.lagless
        assert lagless is not None, f"{self.key} has a lag"
        return replace(self, forward=lambda ideal, _: lagless(ideal, theta))


def each_axis(unit: str, plausible: float, before: str = "") -> tuple[Parameter, ...]:
    """One parameter for each axis, its name with a prefix."""
    return tuple(Parameter(before + axis, unit, plausible) for axis in AXES)


def each_pair(unit: str, plausible: float, *, diagonal: bool = True, before: str = "") -> tuple[Parameter, ...]:
    """One parameter for each entry of a 3x3 matrix, row by row: `xy` is what y adds to x."""
    return tuple(Parameter(before + a + b, unit, plausible) for a in AXES for b in AXES if diagonal or a != b)


def starts_at(*starts: Sequence[float]) -> Callable[[IdealMotion, SensorSamples], Sequence[Theta]]:
    """Starts of a fit that are the same for every log."""
    return lambda _motion, _samples: [np.array(theta) for theta in starts]


def matrix(theta: Float64[np.ndarray, "6"]) -> Float64[np.ndarray, "3 3"]:
    """The matrix with these entries off its diagonal, row by row, and zeros on it."""
    out = np.zeros((3, 3))
    out[~np.eye(3, dtype=bool)] = theta
    return out


def attitude_of(motion: IdealMotion, effect: str) -> Float64[np.ndarray, "n 3 3"]:
    """R_wb, for an effect that needs it.

    Raises:
        DataError: the motion has no attitude.
    """
    if motion.R_wb is None:
        raise DataError("the attitude is not known", where=effect, expected="a motion with orientations")
    return motion.R_wb


class Remembered:
    """Function of a clock and one number that keeps its last value, for derivatives."""

    def __init__(self, function: Callable[[Times, float], Float64[np.ndarray, "n ..."]]) -> None:
        self._function = function
        self._last: tuple[Times, float, Float64[np.ndarray, "n ..."]] | None = None

    def __call__(self, t_s: Times, x: float) -> Float64[np.ndarray, "n ..."]:
        """Its value, which is read-only."""
        last = self._last  # replaced as a whole, so that threads may share it
        if last is None or last[1] != x or not np.array_equal(last[0], t_s):
            last = self._last = t_s.copy(), x, self._function(t_s, x)
            last[2].flags.writeable = False
        return last[2]


def residual(motion: IdealMotion, samples: SensorSamples) -> tuple[Vectors, Vectors]:
    """Samples minus ideal ones at the same stamps, to start a fit from: rad/s, m/s²."""
    ideal = motion.sample(samples.stamp_s, samples.stamp_s)
    return samples.gyro - ideal.gyro, samples.accel - ideal.accel


WITHIN_STAGE = {
    **{"declination": -4, "magnetometer_misalignment": -3, "soft_iron": -2},  # S R m_0 + h: the offset comes behind them
    "mount_rotation:step": -1,  # ahead of scales, as the mount of the whole log
    **{"gain": -2, "dead_band": -1, "gyro_g_sensitivity": 1, "saturation": 1, "quantization": 2},
    **{"coulomb_friction": 1, "stribeck_friction": 1, "actuator_gain": 2},  # they hold what all else leaves of a command
    **{"actuator_dead_band": 3, "torque_saturation": 3},  # between what the motion needs and the command
}
Acting = Sequence[tuple[Effect, Theta]]


@dataclass(frozen=True, eq=False)
class SignalState:
    """Signals between two effects: a motion and its sample times or, behind the clock, samples."""

    motion: Any  # an `IdealMotion`, or another signal with the same method `sample`
    taken_s: Times
    stamp_s: Times
    taken: Any = None

    def through(self, effect: Effect, theta: Theta) -> SignalState:
        """The signals behind one more effect, the next in stage order."""
        if effect.stage < Stage.CLOCK:
            return SignalState(effect.forward(self.motion, theta), self.taken_s, self.stamp_s)
        if effect.stage == Stage.CLOCK:
            return SignalState(self.motion, effect.forward(self.taken_s, theta), self.stamp_s)
        return SignalState(self.motion, self.taken_s, self.stamp_s, effect.forward(self.samples(), theta))

    def sampled(self) -> SignalState:
        """The signals with the samples taken: behind this, clock and motion do not matter any more."""
        return self if self.taken is not None else SignalState(self.motion, self.taken_s, self.stamp_s, self.samples())

    def samples(self) -> Any:
        """One row a sample."""
        return self.motion.sample(self.taken_s, self.stamp_s) if self.taken is None else self.taken


def simulate_stretches(
    motions: Sequence[IdealMotion], stamps: Sequence[Float64[np.ndarray, " _"]], acting: Acting
) -> SensorSamples:
    """Samples of a sensor with these effects over several stretches of one motion.

    Clock and sensor know of no stretches: a drift goes on from one to the next, a clock jumps once.
    """
    order = in_stage_order(acting)
    for effect, theta in order:
        if effect.stage < Stage.CLOCK:
            motions = [effect.forward(motion, theta) for motion in motions]
    stamp_s = np.concatenate(stamps)
    taken_s, stretch = stamp_s, np.repeat(np.arange(len(motions)), [len(part) for part in stamps])
    for effect, theta in order:
        if effect.stage == Stage.CLOCK:
            taken_s = effect.forward(taken_s, theta)
    parts = []
    for k, motion in enumerate(motions):
        rows = (stretch == k) & (taken_s >= motion.t_s[0]) & (taken_s <= motion.t_s[-1])
        if rows.any():
            parts.append(motion.sample(taken_s[rows], stamp_s[rows]))
    if not parts:
        raise DataError("the clock takes every sample outside the motion", expected="a smaller offset")
    return distort(SensorSamples.joined(parts), acting)


def distort(samples: SensorSamples, acting: Acting) -> SensorSamples:
    """Samples behind the stages SENSOR and CONVERTER alone."""
    for effect, theta in in_stage_order(acting):
        if effect.stage > Stage.CLOCK:
            samples = effect.forward(samples, theta)
    return samples


def in_stage_order(acting: Acting) -> list[tuple[Effect, Theta]]:
    """The effects in the order in which they act."""
    return sorted(acting, key=lambda pair: stage_order(pair[0]))


def stage_order(effect: Effect) -> tuple[int, int, str]:
    """Sorting key of an effect: stage, place within it, key: S M omega + G f + b (Rehder 2016)."""
    return effect.stage, WITHIN_STAGE.get(effect.key, WITHIN_STAGE.get(effect.name, int(effect.of_time))), effect.key
