"""Load of a joint: payload on the last link, inertia of the rotor.

A point mass m at (x, y) of the last link adds m |P|², m conj(P_i) P_j and m P_i to the coefficients of the chain
(`joint_dynamics`); a rotor behind a gear adds J (rad/s²) to its own joint (Spong, Hutchinson, Vidyasagar, Robot Modeling and
Control, eq. 7.41).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from imutool.sensor.effect import Effect, Parameter, Theta
from imutool.sensor.robot_effects.joint_dynamics import chain_columns, mass_coefficients
from imutool.sensor.robot_effects.scale import Scale
from imutool.sensor.robot_effects.signal_samples import SignalSamples, State

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


def effects(scale: Scale) -> Iterator[Effect]:
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
