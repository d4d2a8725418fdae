"""GNSS antenna: lever arm and latency of a position.

p = p_body + R_wb r (Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems, section 14.3), sampled
`delay` before its stamp.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from imutool.sensor.effect import Effect, Parameter, Theta
from imutool.sensor.robot_effects.magnetometer import attitude, delay
from imutool.sensor.robot_effects.scale import Scale
from imutool.sensor.robot_effects.signal_samples import SignalSamples
from imutool.units import AXES


def _arm(s: SignalSamples, theta: Theta) -> SignalSamples:
    return s.but(s.y + np.einsum("nij,j->ni", attitude(s), theta))


def effects(scale: Scale) -> Iterator[Effect]:
    """Lever arm where the log has an attitude, and latency."""
    if "R00" in scale.state:
        numbers = tuple(Parameter(axis, "m", 1.0) for axis in AXES)
        yield scale.effect("gnss_lever_arm", scale.columns, "position += R_wb r", numbers, _arm, "it turns")
    yield delay(scale, "latency")
