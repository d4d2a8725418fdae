"""Effects in the effort of a joint: friction, payload and rotor, actuator.

Coulomb, viscous and Stribeck friction: tau = (F_c + F_s exp(-(v / v_s)^2)) sign(v) + F_v v (Armstrong-Helouvry, Dupont, Canudas
de Wit, A survey of models, analysis tools and compensation methods for the control of machines with friction, Automatica 30
(1994), eq. 2 to 6).

A point mass m at (x, y) of the last link adds m |P|², m conj(P_i) P_j and m P_i to the coefficients of the chain
(`joint_dynamics`); a rotor behind a gear adds J (rad/s²) to its own joint (Spong, Hutchinson, Vidyasagar, Robot Modeling and
Control, eq. 7.41).

The log holds the commanded effort u; what acts is u some time later, less and limited (Slotine and Li, Applied Nonlinear
Control, section 5.2). So u(t) = effort that the motion needs at t + delay, over the gain, plus what the actuator kept back.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import binary_opening

from imutool.array_types import Float64
from imutool.sensor.effect import Effect, Parameter, Stage, Theta
from imutool.sensor.robot_effects.joint_dynamics import chain_columns, mass_coefficients
from imutool.sensor.robot_effects.scale import Scale
from imutool.sensor.robot_effects.signal_samples import Samples, SignalSamples, State

STEEP, LEAST_STEEP = 3.0, 1e-3  # of the velocity's noise and size, within which its sign turns
AT_REST, LEAST_REST = 4.0, 3  # of that velocity, and samples: a joint that turns round is faster
PLAUSIBLE_SHARE = 0.5  # of the effort's standard deviation
STRIBECK = (0.03, 0.1, 0.3)  # velocities to start from, over the standard deviation
SLOWEST = 0.5  # a faster fall is Coulomb friction, over the standard deviation


@dataclass(frozen=True)
class _Friction:
    joint: int
    steep: float
    kind: str
    slowest: float
    command: str = ""

    def __call__(self, s: SignalSamples, theta: Theta) -> SignalSamples:
        if self.kind == "viscous":
            return s.with_added(self.joint, theta[0] * s.state[f"dq{self.joint}"])
        velocity = s.state[f"v{self.joint}"]
        sign = np.clip(velocity / self.steep, -1.0, 1.0)
        force = theta[0] * sign * (self._near_rest(velocity, theta) if len(theta) > 1 else 1.0)
        if self.command:
            rests = binary_opening(np.abs(velocity) < AT_REST * self.steep, np.ones(LEAST_REST, bool))
            held = np.clip(s.channel(self.command) - s.y[:, self.joint], -np.abs(theta[0]), np.abs(theta[0]))
            force = np.where(rests, held, force)
        return s.with_added(self.joint, force)

    def _near_rest(self, velocity: Float64[np.ndarray, " n"], theta: Theta) -> Float64[np.ndarray, " n"]:
        return np.asarray(np.exp(-((velocity / min(theta[1], self.slowest)) ** 2)))


def with_stiction(effect: Effect) -> Effect:
    """Coulomb friction that holds a joint at rest; any other effect as it is.

    At rest the force is what the command leaves over, up to the level (eq. 3 of the survey): sliding alone shows the level. It
    follows the recording there, and can therefore not be searched for.
    """
    if effect.name != "coulomb_friction" or not isinstance(effect.forward, _Friction):
        return effect
    return replace(effect, forward=replace(effect.forward, command=effect.sensors[0]), linear=False)


def friction_effects(scale: Scale) -> Iterator[Effect]:
    """Coulomb, viscous and Stribeck friction of each joint."""
    for k in scale.columns:
        size, speed, unit = PLAUSIBLE_SHARE * scale.size[k], scale.state[f"dq{k}"], scale.units[k]
        steep, slowest = max(STEEP * scale.state[f"noise{k}"], LEAST_STEEP * speed), SLOWEST * speed
        level = Parameter("level", unit, size)
        yield scale.effect(
            "coulomb_friction",
            (k,),
            "effort += level sign(velocity)",
            (level,),
            _Friction(k, steep, "coulomb", slowest),
            "the joint turns both ways",
        )
        yield scale.effect(
            "viscous_friction",
            (k,),
            "effort += coefficient velocity",
            (Parameter("coefficient", f"{unit} s/rad".strip(), size / speed),),
            _Friction(k, steep, "viscous", slowest),
            "the velocity varies",
        )
        yield scale.effect(
            "stribeck_friction",
            (k,),
            "effort += level exp(-(velocity / slow)^2) sign(velocity)",
            (level, Parameter("slow", "rad/s", speed, positive=True, step=0.02, least=4.0 * steep)),
            _Friction(k, steep, "stribeck", slowest),
            "the joint turns slowly and fast, both ways",
            starts=[np.array([0.1 * size, share * speed]) for share in STRIBECK],
        )


USUAL_ARM_M = 0.3  # of a payload, where gravity shows no length
PLAUSIBLE_KG = 2.0


class _Payload:
    def __init__(self, signs: tuple[int, ...], links: tuple[complex, ...]) -> None:
        self.signs, self.links = signs, links
        self._last: tuple[State, Float64[np.ndarray, "_ _ _"]] | None = None

    def __call__(self, s: SignalSamples, theta: Theta) -> SignalSamples:
        if self._last is None or self._last[0] is not s.state:  # a fit asks for other masses at the same motion
            self._last = s.state, chain_columns(s.state, self.signs)
        coefficients = mass_coefficients(theta[0], [*self.links, complex(theta[1], theta[2])])
        return s.but(s.y + self._last[1] @ coefficients)


@dataclass(frozen=True)
class _Rotor:
    joint: int

    def __call__(self, s: SignalSamples, theta: Theta) -> SignalSamples:
        return s.with_added(self.joint, theta[0] * s.state[f"ddq{self.joint}"])


def load_effects(scale: Scale) -> Iterator[Effect]:
    """Payload of a chain of hinges, and a rotor of each joint."""
    n, dynamics = len(scale.names), scale.dynamics
    if dynamics is not None and dynamics.signs and (n == 1 or dynamics.links):
        arm = float(np.mean(np.abs(dynamics.links))) if dynamics.links else USUAL_ARM_M
        parameters = (
            Parameter("mass", "kg", PLAUSIBLE_KG, positive=True, step=0.01),
            Parameter("x", "m", max(arm, 0.1)),
            Parameter("y", "m", max(arm, 0.1)),
        )
        yield scale.effect(
            "payload",
            scale.columns,
            "a point mass at (x, y) of the last link, whose axes are level and up where all angles are zero",
            parameters,
            _Payload(dynamics.signs, dynamics.links),
            "the arm moves against gravity, and fast enough for its inertia to show",
            starts=[np.array([0.3, *(arm * np.array(at))]) for at in ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))],
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


PLAUSIBLE_S, MOVED = 0.05, 0.005
WIDTHS = (0.05, 0.15, 0.4)  # of a dead band, over the effort's standard deviation
LIMITS = (1.0, 1.5, 2.0)


@dataclass(frozen=True)
class _Kept:
    """What the actuator keeps back of a command: all within `width`, or what is above `limit`."""

    joint: int
    name: str
    limits: bool

    def __call__(self, s: SignalSamples, theta: Theta) -> SignalSamples:
        u: Samples = s.channel(self.name)
        inside = np.clip(u, -theta[0], theta[0])
        return s.with_added(self.joint, u - inside if self.limits else inside)


def _delayed(taken_s: Samples, theta: Theta) -> Samples:
    return np.asarray(taken_s + theta[0])


def actuator_effects(scale: Scale) -> Iterator[Effect]:
    """Delay of all joints; gain, dead band and limit of each."""
    step = MOVED * min(size / slope for size, slope in zip(scale.size, scale.slope, strict=True))
    yield scale.effect(
        "actuator_delay",
        scale.columns,
        "the effort acts `delay` after it is commanded",
        (Parameter("delay", "s", PLAUSIBLE_S, step=step),),
        _delayed,
        "the effort varies",
        stage=Stage.CLOCK,
        starts=[np.zeros(1), np.array([0.02]), np.array([0.06])],
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
    for name, limits, shares, text in (
        ("actuator_dead_band", False, WIDTHS, "a command within +-width does nothing, and beyond it loses as much"),
        ("torque_saturation", True, LIMITS, "a command beyond +-limit acts as the limit"),
    ):
        yield scale.effect(
            name,
            (k,),
            text,
            (Parameter("limit" if limits else "width", unit, size, positive=True, step=0.01),),
            _Kept(k, scale.names[k], limits),
            "the effort goes beyond the limit" if limits else "the effort goes through zero",
            starts=[np.array([share * size]) for share in shares],
        )
