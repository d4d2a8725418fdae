"""Friction of a joint, in its effort: Coulomb, viscous, Stribeck, and stiction at rest.

tau = (F_c + F_s exp(-(v / v_s)^2)) sign(v) + F_v v (Armstrong-Helouvry, Dupont, Canudas de Wit, A survey of models, analysis
tools and compensation methods for the control of machines with friction, Automatica 30 (1994), eq. 2 to 6).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import binary_opening

from imutool.sensor.effect import Effect, Parameter, Theta
from imutool.sensor.robot_effects.signal_samples import SignalSamples
from imutool.sensor.robot_effects.signal_sizes import Scale

STEEP, MIN_STEEP = 3.0, 1e-3  # of the velocity's noise and size, within which its sign turns
AT_REST, MIN_REST = 4.0, 3  # of that velocity, and samples: a joint that turns round is faster
PLAUSIBLE_SHARE = 0.5  # of the effort's standard deviation
STRIBECK = (0.03, 0.1, 0.3)  # velocities to start from, over the standard deviation
SLOWEST = 0.5  # a faster fall is Coulomb friction, over the standard deviation


@dataclass(frozen=True)
class _Friction:
    joint: int
    steep: float
    kind: str
    slowest: float
    command: str
    holds: bool = False

    def __call__(self, s: SignalSamples, theta: Theta) -> SignalSamples:
        if self.kind == "viscous":
            return s.with_added(self.joint, theta[0] * s.state[f"dq{self.joint}"])
        velocity = s.state[f"v{self.joint}"]
        force = theta[0] * np.clip(velocity / self.steep, -1.0, 1.0)
        if len(theta) > 1:
            force = force * np.exp(-((velocity / min(theta[1], self.slowest)) ** 2))
        if self.holds:
            rests = binary_opening(np.abs(velocity) < AT_REST * self.steep, np.ones(MIN_REST, bool))
            stiction = np.clip(s.channel(self.command) - s.y[:, self.joint], -np.abs(theta[0]), np.abs(theta[0]))
            force = np.where(rests, stiction, force)
        return s.with_added(self.joint, force)


def with_stiction(effect: Effect) -> Effect:
    """Dry friction that holds a joint at rest; any other effect as it is.

    At rest the force is what the command leaves over, up to Coulomb's and Stribeck's level together (eq. 3 of the survey):
    sliding alone shows the levels. It follows the recording there, so that only sliding may bring it in; what else acts is then
    searched for together with it.
    """
    forward = effect.forward
    if not isinstance(forward, _Friction) or forward.kind == "viscous" or forward.holds:
        return effect
    return replace(effect, forward=replace(forward, holds=True), linear=False)


def holds(effect: Effect) -> bool:
    """Whether an effect is dry friction that holds a joint at rest."""
    return isinstance(effect.forward, _Friction) and effect.forward.holds


def friction_effects(scale: Scale) -> Iterator[Effect]:
    """Coulomb, viscous and Stribeck friction of each joint."""
    for k in scale.columns:
        size, speed, unit = PLAUSIBLE_SHARE * scale.size[k], scale.state[f"dq{k}"], scale.units[k]
        steep, slowest = max(STEEP * scale.state[f"noise{k}"], MIN_STEEP * speed), SLOWEST * speed
        level = Parameter("level", unit, size)
        yield scale.effect(
            "coulomb_friction",
            (k,),
            "effort += level sign(velocity)",
            (level,),
            _Friction(k, steep, "coulomb", slowest, scale.names[k]),
            "the joint turns both ways",
        )
        yield scale.effect(
            "viscous_friction",
            (k,),
            "effort += coefficient velocity",
            (Parameter("coefficient", f"{unit} s/rad".strip(), size / speed),),
            _Friction(k, steep, "viscous", slowest, scale.names[k]),
            "the velocity varies",
        )
        yield scale.effect(
            "stribeck_friction",
            (k,),
            "effort += level exp(-(velocity / slow)^2) sign(velocity)",
            (level, Parameter("slow", "rad/s", speed, positive=True, step=0.02, minimum=4.0 * steep)),
            _Friction(k, steep, "stribeck", slowest, scale.names[k]),
            "the joint turns slowly and fast, both ways",
            starts=[np.array([0.1 * size, share * speed]) for share in STRIBECK],
        )
