"""Barometer: dynamic pressure and temperature; its lag is the `low_pass` of any signal.

p = p_static + C rho v² / 2 (Bolanakis, MEMS barometers toward vertical position detection, 2017, section 4), and a share of
the temperature.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from imutool.sensor.effect import Effect, Parameter, Theta
from imutool.sensor.robot_effects.scale import Scale
from imutool.sensor.robot_effects.signal_samples import SignalSamples

AIR_KG_M3 = 1.225


@dataclass(frozen=True)
class _Temperature:
    name: str

    def __call__(self, s: SignalSamples, theta: Theta) -> SignalSamples:
        values = s.channel(self.name)
        return s.with_added(0, theta[0] * (values - values.mean()))


def _dynamic(s: SignalSamples, theta: Theta) -> SignalSamples:
    return s.with_added(0, theta[0] * 0.5 * AIR_KG_M3 * s.state["speed"] ** 2)


def effects(scale: Scale) -> Iterator[Effect]:
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
