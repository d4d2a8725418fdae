"""Actuator and load of a joint: delay, gain, dead band, limit; payload, rotor.

A mass m at (x, y) of the last link, of inertia I about its own centre, adds m |P|², m conj(P_i) P_j and m P_i to the
coefficients of the chain (`joint_dynamics`), and I to that of its link; a rotor behind a gear adds J (rad/s²) to its own joint
(Spong, Hutchinson, Vidyasagar, Robot Modeling and Control, eq. 7.41).

The log holds the commanded effort u; what acts is u some time later, less and limited (Slotine and Li, Applied Nonlinear
Control, section 5.2). So u(t) = effort that the motion needs at t + delay, over the gain, plus what the actuator kept back.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from imutool.inertial.stationary import white_noise
from imutool.sensor.effect import Effect, Parameter, Stage, Theta
from imutool.sensor.robot_effects.joint_dynamics import Dynamics
from imutool.sensor.robot_effects.signal_samples import Columns, IdealSignal, Samples, SignalSamples, State
from imutool.sensor.robot_effects.signal_sizes import Scale

USUAL_ARM_M = 0.3  # of a payload, where gravity shows no length
PLAUSIBLE_KG = 2.0
SPREAD_M = 0.1  # of a payload about its centre
OFFSET_M = 0.1  # of two axes of a wrist
UNLIKE, NOISIEST = 0.5, 2.0  # of the needed effort: what acts may differ from it so much, and beyond that by such a noise
PLAUSIBLE_S, MOVED = 0.05, 0.005
LONGEST_S, MIN_DELAYS, MAX_DELAYS = 0.08, 5, 40  # of a delay to start from, and how many are looked at
WIDTHS = (0.05, 0.15, 0.4)  # of a dead band, over the effort's standard deviation
LIMITS = (0.5, 1.0, 1.5, 2.0)  # to start from, likewise
ASKED = (0.05, 0.3)  # of the commands, the largest, while what acts is such a limit
BEYOND = (0.003, 0.01, 0.03, 0.1)  # of the commands, that another limit to start from cuts
EXTENT = "; inertia: about its own centre, alike about all axes"
OFFSETS = "; offsets: lengths before it, which the simulated arm's own weight does not show"
AXES = {2: "whose axes are level and up", 3: "whose third axis is up"}


class _Payload:
    def __init__(self, dynamics: Dynamics) -> None:
        self.dynamics = dynamics
        self._last: tuple[State, Callable[[Theta], Columns]] | None = None

    def __call__(self, s: SignalSamples, theta: Theta) -> SignalSamples:
        if self._last is None or self._last[0] is not s.state:  # a fit asks for other masses at the same motion
            self._last = s.state, self.dynamics.loaded(s.state)
        return s.but(s.y + self._last[1](theta))


@dataclass(frozen=True)
class _Rotor:
    joint: int

    def __call__(self, s: SignalSamples, theta: Theta) -> SignalSamples:
        return s.with_added(self.joint, theta[0] * s.state[f"ddq{self.joint}"])


def with_extent(effect: Effect) -> Effect:
    """A payload with an inertia about its own centre; any other effect as it is.

    One joint does not tell it from a rotor's. While effects are missing, it takes what is no load's: it is fitted last.
    """
    if not isinstance(effect.forward, _Payload) or effect.forward.dynamics.joints == 1:
        return effect
    inertia = Parameter("inertia", "kg m²", PLAUSIBLE_KG * SPREAD_M**2)
    return replace(effect, parameters=(*effect.parameters, inertia), equation=f"{effect.equation}{EXTENT}")


def load_effects(scale: Scale) -> Iterator[Effect]:
    """Payload of a chain of hinges, and a rotor of each joint."""
    dynamics = scale.dynamics
    if dynamics is not None and (reach := dynamics.reach) is not None:
        arm, letters = reach or USUAL_ARM_M, "xy" if dynamics.spatial is None else "xyz"
        place = tuple(Parameter(letter, "m", max(arm, 0.1)) for letter in letters)
        offsets = tuple(Parameter(f"offset_{k + 1}", "m", OFFSET_M) for k in range(dynamics.offsets))
        axes, more = np.eye(len(letters), len(letters) + len(offsets)), OFFSETS if offsets else ""
        yield scale.effect(
            "payload",
            scale.columns,
            f"a mass at ({', '.join(letters)}) of the last link, {AXES[len(letters)]} where all angles are zero{more}",
            (Parameter("mass", "kg", PLAUSIBLE_KG, positive=True, step=0.01), *place, *offsets),
            _Payload(dynamics),
            "the arm moves against gravity, and fast enough for its inertia to show",
            starts=[np.array([0.3, *(arm * at)]) for axis in axes for at in (axis, -axis)],
        )
    for k in scale.columns:
        yield scale.effect(
            "rotor_inertia",
            (k,),
            "effort += inertia acceleration",
            (Parameter("inertia", "kg m²", 0.5 * scale.size[k] / scale.state[f"ddq{k}"]),),
            _Rotor(k),
            "the joint accelerates",
        )


@dataclass(frozen=True)
class _Kept:
    """What the actuator keeps back of a command: all within `width`, or what is above `limit`.

    What acts has to be like the effort that the motion needs, but for the noise with which it is read: a command alone would
    explain itself, and hide a large friction.
    """

    joint: int
    name: str
    limits: bool

    def __call__(self, s: SignalSamples, theta: Theta) -> SignalSamples:
        u: Samples = s.channel(self.name)
        inside = np.clip(u, -theta[0], theta[0])
        kept, needed = (u - inside if self.limits else inside), s.y[:, self.joint]
        passed = np.mean((np.abs(u) < theta[0]) == self.limits)
        size, noise = np.var(needed), white_noise(u[:, None])[0] ** 2
        unlike = np.var(u - kept - needed) - passed * min(noise, NOISIEST**2 * size)
        return s.with_added(self.joint, kept) if unlike < UNLIKE**2 * size else s


def _delayed(taken_s: Samples, theta: Theta) -> Samples:
    return np.asarray(taken_s + theta[0])


def _delays(ideal: IdealSignal, real: SignalSamples, turn_s: float) -> list[Theta]:
    """None, and the delay that commands are most like: from others an effort that oscillates leads a period away."""
    tried = np.linspace(0.0, LONGEST_S, int(np.clip(2.0 * LONGEST_S / turn_s, MIN_DELAYS, MAX_DELAYS)))

    def unlike(delay_s: float) -> float:
        needed = ideal.sample(real.stamp_s + delay_s, real.stamp_s).x
        return float((np.var(real.y - needed, axis=0) / np.maximum(np.var(real.y, axis=0), 1e-300)).sum())

    return [np.zeros(1), np.array([min(tried[1:], key=unlike)])]


def actuator_effects(scale: Scale) -> Iterator[Effect]:
    """Delay of all joints; gain, dead band and limit of each."""
    turn_s = min(size / slope for size, slope in zip(scale.size, scale.slope, strict=True))  # an effort turns by a radian
    yield scale.effect(
        "actuator_delay",
        scale.columns,
        "the effort acts `delay` after it is commanded",
        (Parameter("delay", "s", PLAUSIBLE_S, step=MOVED * turn_s),),
        _delayed,
        "the effort varies",
        stage=Stage.CLOCK,
        starts=lambda ideal, real: _delays(ideal, real, turn_s),
    )
    for k in scale.columns:
        yield from _of_joint(scale, k)


def _of_joint(scale: Scale, k: int) -> Iterator[Effect]:
    size, unit = scale.size[k], scale.units[k]

    def gain(s: SignalSamples, theta: Theta) -> SignalSamples:
        return s.with_column(k, s.y[:, k] / theta[0])

    yield scale.effect(
        "actuator_gain",
        (k,),
        "acting effort = gain commanded effort",
        (Parameter("gain", "-", 0.3, null_value=1.0),),
        gain,
        "the effort varies",
        starts=[np.ones(1)],
    )
    yield scale.effect(
        "actuator_dead_band",
        (k,),
        "a command within +-width does nothing, and beyond it loses as much",
        (Parameter("width", unit, size, positive=True, step=0.01),),
        _Kept(k, scale.names[k], limits=False),
        "the effort goes through zero",
        starts=[np.array([share * size]) for share in WIDTHS],
    )
    yield scale.effect(
        "torque_saturation",
        (k,),
        "a command beyond +-limit acts as the limit",
        (Parameter("limit", unit, size, positive=True, step=0.01),),
        _Kept(k, scale.names[k], limits=True),
        "the effort goes beyond the limit",
        starts=lambda ideal, real: _limits(real.y[:, k], real.x[:, k], size),
    )


def _limits(commands: Samples, needed: Samples, size: float) -> list[Theta]:
    """Limits to start from: a controller asks now for much more than acts, and now goes beyond a limit for a moment only.

    What acts while most is asked for is the limit, however far a controller winds up.
    """
    u, acts = np.abs(commands), np.abs(needed)
    moments = np.quantile(u, 1.0 - np.array(BEYOND))
    plateaus = [np.median(acts[u >= minimum]) for minimum in np.quantile(u, 1.0 - np.array(ASKED))]
    return [np.array([limit]) for limit in (*(share * size for share in LIMITS), *moments, *plateaus) if limit > 0.0]
