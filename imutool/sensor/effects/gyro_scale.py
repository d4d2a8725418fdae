"""Scale error of the gyro: omega (1 + s), per axis; with `t_step` it begins at that time."""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from imutool.array_types import Float64
from imutool.sensor.effect import Effect, Parameter, Stage, Theta, each_axis, residual
from imutool.sensor.effects import gyro_delay, gyro_g_sensitivity, mount_rotation
from imutool.sensor.effects.gyro_bias_step import followed, likeliest_onset
from imutool.sensor.samples import IdealMotion, SensorSamples
from imutool.units import Sensor

STEP = "step"  # variant of an effect that sets in at one time, also next to that of the whole log
T_STEP = Parameter("t_step", "s", 30.0, begins=True)


def scale(sensor: Sensor, symbol: str, plausible: float, observable_if: str) -> Effect:
    """Scale error of either sensor."""

    def forward(samples: SensorSamples, s: Theta) -> SensorSamples:
        return samples.with_gain(sensor, s)

    name, equation = f"{sensor}_scale", f"{sensor} += s * {symbol}"
    return Effect(name, Stage.SENSOR, (sensor,), equation, each_axis("-", plausible), observable_if, forward, trained=True)


def of_form(effect: Effect, names: Container[str]) -> Effect:
    """Effect from one time on if it may set in and `t_step` is named, any other effect itself."""
    return _from_one_time_on(effect) if effect.name in SETTING_IN and T_STEP.name in names else effect


def in_both_forms(effects: Sequence[Effect]) -> Iterator[Effect]:
    """Effects, and behind some of them one that sets in at one time."""
    for effect in effects:
        yield effect
        if effect.name in SETTING_IN:
            yield _from_one_time_on(effect)


def _from_one_time_on(whole: Effect) -> Effect:
    """An effect that sets in, or a mount that slips: its size, then the time (s from the log's start)."""
    if whole.name == mount_rotation.EFFECT.name:
        return replace(mount_rotation.slipping(T_STEP), variant=STEP)
    (sensor,) = whole.sensors

    def forward(signals: Any, theta: Theta) -> Any:
        t_s = signals.t_s if isinstance(signals, IdealMotion) else signals.stamp_s
        on, behind = np.asarray(t_s >= theta[-1])[:, None], whole.forward(signals, theta[:-1])
        readings = {sensor: np.where(on, getattr(behind, sensor), getattr(signals, sensor))}
        return replace(signals, **readings) if isinstance(signals, IdealMotion) else signals.with_readings(**readings)

    def starts(motion: IdealMotion, samples: SensorSamples) -> list[Theta]:
        """The likeliest time at which the error changes, after what most other errors follow."""
        ideal, t_s = motion.sample(samples.stamp_s, samples.stamp_s), samples.stamp_s
        error = residual(motion, samples)[0 if sensor == "gyro" else 1]
        others, columns = np.column_stack([np.ones(len(t_s)), followed(ideal)]), _columns(whole, ideal)
        start = likeliest_onset(t_s, error, others, setting_in=columns)
        if len(start) > len(whole.parameters) + 1:  # one size for all axes
            weights = (columns[0] ** 2).sum(axis=0)
            start = np.array([start[:-1] @ weights / max(weights.sum(), np.finfo(np.float64).tiny), start[-1]])
        return [start]

    return replace(
        whole,
        equation=f"{whole.equation} from t_step on",
        parameters=(*whole.parameters, T_STEP),
        forward=forward,
        linear=False,
        starts=starts,
        alternatives=lambda samples: len(samples.stamp_s),
        variant=STEP,
        trained=False,
    )


def _columns(whole: Effect, ideal: SensorSamples) -> list[Float64[np.ndarray, "n a"]]:
    """What a size of an effect adds to each axis, or to all alike, one after another where several add to it."""
    if whole.name == gyro_delay.EFFECT.name:
        return [-ideal.alpha]
    if whole.name == gyro_g_sensitivity.EFFECT.name:
        return [force[:, None] for force in ideal.accel.T]
    return [getattr(ideal, whole.sensors[0])]


SCALES = ("gyro_scale", "accel_scale")
SETTING_IN = (*SCALES, *(of.EFFECT.name for of in (mount_rotation, gyro_delay, gyro_g_sensitivity)))
EFFECT = scale("gyro", "omega", 0.1, "the axis turns")
