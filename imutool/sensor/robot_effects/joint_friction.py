"""Friction of a joint: Coulomb, viscous and Stribeck, in the effort that moves it.

Armstrong-Helouvry, Dupont, Canudas de Wit, A survey of models, analysis tools and compensation methods for the control of
machines with friction, Automatica 30 (1994), eq. 2 to 6: tau = (F_c + F_s exp(-(v / v_s)^2)) sign(v) + F_v v.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from imutool.sensor.effect import Effect, Parameter, Theta
from imutool.sensor.robot_effects.scale import Scale
from imutool.sensor.robot_effects.signal_samples import SignalSamples

STEEP, LEAST_STEEP = 3.0, 1e-3  # of the velocity's noise and size, within which its sign turns
PLAUSIBLE_SHARE = 0.5  # of the effort's standard deviation
STRIBECK = (0.03, 0.1, 0.3)  # velocities to start from, over the standard deviation
SLOWEST = 0.5  # a faster fall is Coulomb friction, over the standard deviation


@dataclass(frozen=True)
class _Friction:
    joint: int
    steep: float
    kind: str
    slowest: float

    def __call__(self, s: SignalSamples, theta: Theta) -> SignalSamples:
        if self.kind == "viscous":
            return s.with_added(self.joint, theta[0] * s.state[f"dq{self.joint}"])
        velocity = s.state[f"v{self.joint}"]
        sign = np.clip(velocity / self.steep, -1.0, 1.0)
        return s.with_added(self.joint, theta[0] * sign * (self._near_rest(velocity, theta) if len(theta) > 1 else 1.0))

    def _near_rest(self, velocity: Float64[np.ndarray, " n"], theta: Theta) -> Float64[np.ndarray, " n"]:
        return np.asarray(np.exp(-((velocity / min(theta[1], self.slowest)) ** 2)))


def effects(scale: Scale) -> Iterator[Effect]:
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
