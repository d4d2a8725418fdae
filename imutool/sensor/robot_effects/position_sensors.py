"""Barometer: dynamic pressure and temperature. GNSS antenna: lever arm and latency.

The lag of a barometer is the `low_pass` of any signal. p = p_static + C rho v² / 2 (Bolanakis, MEMS barometers toward vertical
position detection, 2017, section 4), and a share of the temperature.

A position of GNSS is p = p_body + R_wb r (Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems,
section 14.3), sampled `delay` before its stamp.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from imutool.sensor.effect import Effect, Parameter, Theta
from imutool.sensor.robot_effects.magnetometer import attitude, delay
from imutool.sensor.robot_effects.scale import Scale
from imutool.sensor.robot_effects.signal_samples import SignalSamples
from imutool.units import AXES

AIR_KG_M3 = 1.225


@dataclass(frozen=True)
class _Temperature:
    name: str

    def __call__(self, s: SignalSamples, theta: Theta) -> SignalSamples:
        values = s.channel(self.name)
        return s.with_added(0, theta[0] * (values - values.mean()))


def _dynamic(s: SignalSamples, theta: Theta) -> SignalSamples:
    return s.with_added(0, theta[0] * 0.5 * AIR_KG_M3 * s.state["speed"] ** 2)


def barometer_effects(scale: Scale) -> Iterator[Effect]:
    """Dynamic pressure where the log has a speed, temperature where it has one."""
    if scale.state.get("speed", 0.0) > 0.0:
        number = (Parameter("coefficient", "-", 1.0),)
        text = "pressure += coefficient rho speed^2 / 2, rho = 1.225 kg/m³"
        yield scale.effect("dynamic_pressure", (0,), text, number, _dynamic, "the speed varies")
    for name in scale.state:
        if "temperature" in name.lower():
            number = (Parameter("slope", f"{scale.units[0]}/K", 50.0),)
            text = f"pressure += slope ({name} - mean)"
            forward = _Temperature(name)
            yield scale.effect("pressure_temperature", (0,), text, number, forward, "the temperature varies", variable=name)


def _arm(s: SignalSamples, theta: Theta) -> SignalSamples:
    return s.but(s.y + np.einsum("nij,j->ni", attitude(s), theta))


def gnss_effects(scale: Scale) -> Iterator[Effect]:
    """Lever arm where the log has an attitude, and latency."""
    if "R00" in scale.state:
        numbers = tuple(Parameter(axis, "m", 1.0) for axis in AXES)
        yield scale.effect("gnss_lever_arm", scale.columns, "position += R_wb r", numbers, _arm, "it turns")
    yield delay(scale, "latency")
