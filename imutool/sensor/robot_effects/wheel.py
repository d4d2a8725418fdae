"""Wheels of a vehicle: radius, track width and slip, in the motion that they make.

v = (r_l w_l + r_r w_r) / 2 and w = (r_r w_r - r_l w_l) / track (Siegwart, Introduction to Autonomous Mobile Robots, eq. 3.9);
a driven tyre slips by a share that grows with its force (Pacejka, Tire and Vehicle Dynamics, eq. 1.15).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from imutool.sensor.effect import Effect, Parameter, Stage, Theta
from imutool.sensor.robot_effects.signal_samples import Columns, IdealSignal, SignalSamples, State
from imutool.sensor.robot_effects.signal_sizes import Scale, delay_of_all

FORWARD, TURN = 0, 1
PLAUSIBLE = 0.1


@dataclass(frozen=True, eq=False)
class WheelRelation:
    """Forward speed and turning rate as sums of wheel speeds, as the simulation has them."""

    weights: Columns

    def __call__(self, state: State) -> Columns:
        """Columns `forward` and `turn`."""
        return np.asarray(np.stack([state[f"w{k}"] for k in range(len(self.weights))], axis=1) @ self.weights)


def _radii(ideal: IdealSignal, theta: Theta) -> IdealSignal:
    return ideal.with_state(**{f"w{k}": ideal.state[f"w{k}"] * (1.0 + change) for k, change in enumerate(theta)})


def _track(s: SignalSamples, theta: Theta) -> SignalSamples:
    return s.with_column(TURN, s.y[:, TURN] / (1.0 + theta[0]))


def _slip(s: SignalSamples, theta: Theta) -> SignalSamples:
    return s.with_added(FORWARD, -theta[0] * s.dx[:, FORWARD] * np.abs(s.x[:, FORWARD]))


def effects(scale: Scale) -> Iterator[Effect]:
    """Radius of each wheel, track, slip, and the time by which the speeds come after the wheels."""
    wheels = [name for name in scale.state if name.startswith("w")]
    yield scale.effect(
        "wheel_radius",
        scale.columns,
        "radius of a wheel = its radius in the simulation (1 + change)",
        tuple(Parameter(f"wheel_{k}", "-", PLAUSIBLE) for k in range(len(wheels))),
        _radii,
        "the wheels turn",
        stage=Stage.MOUNT,
        starts=[np.zeros(len(wheels))],
    )
    yield scale.effect(
        "track_width",
        (TURN,),
        "track = track in the simulation (1 + change)",
        (Parameter("change", "-", PLAUSIBLE),),
        _track,
        "the vehicle turns",
        starts=[np.zeros(1)],
    )
    yield scale.effect(
        "wheel_slip",
        (FORWARD,),
        "speed -= slip acceleration |speed|",
        (Parameter("slip", "s²/m", PLAUSIBLE),),
        _slip,
        "the vehicle speeds up and brakes while it moves",
    )
    yield delay_of_all(scale, "delay")
