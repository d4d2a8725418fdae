"""Catalogue of the effects that a blind case may conceal, with their plausible sizes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from imutool.blind_cases import effects as forward
from imutool.blind_cases.effects import ACCEL, GYRO, Model, Parameter, Six, Stage, Theta, on

AXES = "xyz"
PAIRS = tuple(a + b for a in AXES for b in AXES)
NO_LIMIT = 1e9  # a sensor that never clips
CLIPPED_PERCENT = 5.0


def clipping(theta: Theta, size: float, signal: Six) -> Theta:
    """Limits that clip the largest axis 5 % of the time at the plausible size.

    A quarter of that at a quarter of it.
    """
    share = 100.0 - CLIPPED_PERCENT * size
    at = np.array([np.percentile(np.abs(signal[:, part]).max(axis=1), share) for part in (GYRO, ACCEL)])
    return np.where(theta < NO_LIMIT, at, NO_LIMIT)


def _quicker(theta: Theta, size: float, signal: Six) -> Theta:
    """A cut-off grows as the effect shrinks: its time constant is the amount."""
    return theta / size


def _axes(unit: str, plausible: float, prefix: str = "") -> tuple[Parameter, ...]:
    return tuple(Parameter(prefix + axis, unit, plausible) for axis in AXES)


def _matrix(unit: str, plausible: float, *, diagonal: bool) -> tuple[Parameter, ...]:
    return tuple(Parameter(pair, unit, plausible) for pair in PAIRS if diagonal or pair[0] != pair[1])


def _fixed(name: str, unit: str, plausible: float) -> Parameter:
    """A time or a frequency, which does not grow with the size."""
    return Parameter(name, unit, plausible, amount=False)


def _by_scene(*_: Any) -> None:
    """Stamps and reference are the scene's."""


_LINE = (
    _fixed("f", "Hz", 40.0),
    *_axes("rad/s", 0.1, "gyro_"),
    *_axes("m/s^2", 1.0, "accel_"),
    *(_fixed(f"phase_{k}", "rad", 1.0) for k in range(6)),
)
_TAU = _fixed("tau", "s", 30.0)
_LIMITS = (Parameter("gyro", "rad/s", 2.0), Parameter("accel", "m/s^2", 12.0))
_LSB = (Parameter("gyro", "rad/s", 0.02), Parameter("accel", "m/s^2", 0.2))
_JUMP = (_fixed("t_j", "s", 30.0), Parameter("step", "s", 0.05))
_GRAVITY = (Parameter("g", "m/s^2", 0.05), Parameter("tilt_x", "rad", 0.05), Parameter("tilt_y", "rad", 0.05))
_RESONANCE = (_fixed("f0", "Hz", 15.0), _fixed("zeta", "-", 0.2), *_axes("-", 1.0, "share_"))
_LOST = (Parameter("length", "s", 2.0), *(_fixed(f"t_{k}", "s", 30.0) for k in range(3)))
_G = _matrix("rad/s per m/s^2", 3e-3, diagonal=True)
_SQUARE = _matrix("-", 0.05, diagonal=False)

CATALOGUE: Mapping[str, Model] = {
    model.name: model
    for model in (
        Model("gyro_scale", Stage.SENSOR, "gyro", _axes("-", 0.1), on(GYRO, forward.scale)),
        Model("gyro_misalignment", Stage.SENSOR, "gyro", _SQUARE, on(GYRO, forward.misalignment)),
        Model("gyro_g_sensitivity", Stage.SENSOR, "gyro", _G, forward.g_sensitivity),
        Model("gyro_quadratic", Stage.SENSOR, "gyro", _axes("s/rad", 0.1), on(GYRO, forward.quadratic)),
        Model("gyro_bias_drift", Stage.SENSOR, "gyro", (*_axes("rad/s", 0.02), _TAU), on(GYRO, forward.warm_up)),
        Model("accel_scale", Stage.SENSOR, "accel", _axes("-", 0.05), on(ACCEL, forward.scale)),
        Model("accel_misalignment", Stage.SENSOR, "accel", _SQUARE, on(ACCEL, forward.misalignment)),
        Model("accel_quadratic", Stage.SENSOR, "accel", _axes("s^2/m", 6e-3), on(ACCEL, forward.quadratic)),
        Model("accel_bias_drift", Stage.SENSOR, "accel", (*_axes("m/s^2", 0.5), _TAU), on(ACCEL, forward.warm_up)),
        Model("lever_arm", Stage.IDEAL, "accel", _axes("m", 0.3), forward.lever_arm),
        Model("mount_rotation", Stage.MOUNT, "both", _axes("rad", 0.2), forward.mount_rotation),
        Model("size_effect", Stage.IDEAL, "accel", _matrix("m", 0.02, diagonal=True), forward.size_effect),
        Model("clock_offset", Stage.CLOCK, "both", (Parameter("tau", "s", 0.05),), lambda t, theta: t + theta[0]),
        Model("clock_skew", Stage.CLOCK, "both", (Parameter("eps", "-", 1e-3),), lambda t, theta: t * (1.0 + theta[0])),
        Model("clock_jump", Stage.CLOCK, "both", _JUMP, forward.clock_jump, smooth=False),
        Model("low_pass", Stage.BANDWIDTH, "both", (Parameter("f_c", "Hz", 5.0),), forward.low_pass, _quicker),
        Model("saturation", Stage.CONVERTER, "both", _LIMITS, forward.saturation, clipping, smooth=False),
        Model("quantization", Stage.CONVERTER, "both", _LSB, forward.quantization, smooth=False),
        Model("gravity", Stage.IDEAL, "accel", _GRAVITY, forward.gravity),
        Model(
            "earth_rotation",
            Stage.IDEAL,
            "gyro",
            (_fixed("latitude", "rad", 1.0), _fixed("heading", "rad", 1.0)),
            forward.earth_rotation,
        ),
        Model("vibration", Stage.IDEAL, "both", _LINE, forward.vibration),
        Model("mount_resonance", Stage.MOUNT, "accel", _RESONANCE, forward.mount_resonance),
        Model(
            "temperature",
            Stage.SENSOR,
            "both",
            (*_axes("rad/s/K", 1e-3, "gyro_"), *_axes("m/s^2/K", 1e-2, "accel_")),
            forward.temperature,
        ),
        Model("dropped_samples", Stage.STAMPS, "both", (Parameter("share", "-", 0.02),), _by_scene, smooth=False),
        Model("timestamp_jitter", Stage.STAMPS, "both", (Parameter("std", "s", 2e-3),), _by_scene, smooth=False),
        Model("reference_error", Stage.REFERENCE, "both", _LOST, _by_scene, smooth=False),
    )
}
