"""Sensors of the world: magnetometer, barometer, GNSS.

Magnetometer: soft iron, misalignment and declination; a constant is hard iron. m = S R m_0 + h with S symmetric
(Gebre-Egziabher and others, Calibration of strapdown magnetometers in the magnetic field domain, J. Aerospace Eng. 19, 2006);
the declination turns the field about the vertical of the world.

Barometer: dynamic pressure and temperature. p = p_static + C rho v² / 2 (Bolanakis, MEMS barometers toward vertical position
detection, 2017, section 4), and a share of the temperature. The `low_pass` of any signal is its lag,
and acts on both pressures.

GNSS antenna: lever arm and latency. A position is p = p_body + R_wb r (Groves, Principles of GNSS, Inertial, and Multisensor
Integrated Navigation Systems, section 14.3), sampled `delay` before its stamp.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from imutool.array_types import Float64
from imutool.sensor.effect import Effect, Parameter, Stage, Theta
from imutool.sensor.robot_effects.signal_samples import IdealSignal, SignalSamples
from imutool.sensor.robot_effects.signal_sizes import Scale, delay_of_all
from imutool.units import AXES

AIR_KG_M3 = 1.225
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def _soft(s: SignalSamples, theta: Theta) -> SignalSamples:
    S = np.eye(3)
    for value, (i, j) in zip(theta, PAIRS, strict=True):
        S[i, j] += value
        S[j, i] = S[i, j]
    return s.but(s.y @ S)


def _misaligned(s: SignalSamples, theta: Theta) -> SignalSamples:
    return s.but(s.y @ Rotation.from_rotvec(theta).as_matrix())


def _attitude(s: SignalSamples) -> Float64[np.ndarray, "n 3 3"]:
    """R_wb at the samples, from the state."""
    return np.asarray(np.stack([s.state[f"R{i}{j}"] for i in range(3) for j in range(3)], axis=1).reshape(-1, 3, 3))


def _declined(s: SignalSamples, theta: Theta) -> SignalSamples:
    R = _attitude(s)
    field = np.einsum("nij,nj->ni", R, s.y) @ Rotation.from_rotvec([0.0, 0.0, theta[0]]).as_matrix().T
    return s.but(np.einsum("nji,nj->ni", R, field))


def magnetometer_effects(scale: Scale) -> Iterator[Effect]:
    """Soft iron, misalignment, and with an attitude the declination."""
    yield scale.effect(
        "soft_iron",
        scale.columns,
        "field = S field, S symmetric",
        tuple(Parameter(AXES[i] + AXES[j], "-", 0.1) for i, j in PAIRS),
        _soft,
        "it turns about two axes",
        starts=[np.zeros(6)],
    )
    yield scale.effect(
        "magnetometer_misalignment",
        scale.columns,
        "field = R^T field",
        tuple(Parameter(axis, "rad", 0.2) for axis in AXES),
        _misaligned,
        "it turns about two axes",
        starts=[np.zeros(3)],
    )
    if "R00" in scale.state:
        yield scale.effect(
            "declination",
            scale.columns,
            "the field of the world is turned about its vertical",
            (Parameter("angle", "rad", 0.3),),
            _declined,
            "it rolls or pitches as well as it turns",
            starts=[np.zeros(1)],
        )
    yield delay_of_all(scale, "delay")


@dataclass(frozen=True)
class _Temperature:
    name: str

    def __call__(self, s: SignalSamples, theta: Theta) -> SignalSamples:
        values = s.channel(self.name)
        return s.with_added(0, theta[0] * (values - values.mean()))


def _dynamic(ideal: IdealSignal, theta: Theta) -> IdealSignal:
    return replace(ideal, fine=ideal.fine + theta[0] * 0.5 * AIR_KG_M3 * ideal.state["speed"][:, None] ** 2)


def barometer_effects(scale: Scale) -> Iterator[Effect]:
    """Dynamic pressure where the log has a speed, temperature where it has one."""
    if scale.state.get("speed", 0.0) > 0.0:
        number = (Parameter("coefficient", "-", 1.0),)
        text = "pressure += coefficient rho speed^2 / 2, rho = 1.225 kg/m³"
        yield scale.effect("dynamic_pressure", (0,), text, number, _dynamic, "the speed varies", stage=Stage.MOTION)
    for name in scale.state:
        if "temperature" in name.lower():
            number = (Parameter("slope", f"{scale.units[0]}/K", 50.0),)
            text = f"pressure += slope ({name} - mean)"
            forward = _Temperature(name)
            yield scale.effect("pressure_temperature", (0,), text, number, forward, "the temperature varies", variable=name)


def _arm(s: SignalSamples, theta: Theta) -> SignalSamples:
    return s.but(s.y + np.einsum("nij,j->ni", _attitude(s), theta))


def gnss_effects(scale: Scale) -> Iterator[Effect]:
    """Lever arm where the log has an attitude, and latency."""
    if "R00" in scale.state:
        numbers = tuple(Parameter(axis, "m", 1.0) for axis in AXES)
        yield scale.effect("gnss_lever_arm", scale.columns, "position += R_wb r", numbers, _arm, "it turns")
    yield delay_of_all(scale, "latency")
