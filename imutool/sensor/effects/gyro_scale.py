"""Scale error of the gyro: omega (1 + s), per axis; with `t_step` it begins at that time."""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from dataclasses import replace

import numpy as np

from imutool.sensor.effect import Effect, Parameter, Stage, Theta, each_axis, residual
from imutool.sensor.effects import mount_rotation
from imutool.sensor.effects.gyro_bias_step import followed, likeliest_onset
from imutool.sensor.samples import IdealMotion, SensorSamples
from imutool.units import SENSORS, Sensor

STEP = "step"  # variant of a scale or mount that sets in at one time, also next to that of the whole log
T_STEP = Parameter("t_step", "s", 30.0, begins=True)


def scale(sensor: Sensor, symbol: str, plausible: float, observable_if: str) -> Effect:
    """Scale error of either sensor."""

    def forward(samples: SensorSamples, s: Theta) -> SensorSamples:
        return samples.with_gain(sensor, s)

    name, equation = f"{sensor}_scale", f"{sensor} += s * {symbol}"
    return Effect(name, Stage.SENSOR, (sensor,), equation, each_axis("-", plausible), observable_if, forward, trained=True)


def of_form(effect: Effect, names: Container[str]) -> Effect:
    """A scale or mount from one time on if `t_step` is among the names, any other effect itself."""
    return _from_one_time_on(effect) if effect.name in SETTING_IN and T_STEP.name in names else effect


def in_both_forms(effects: Sequence[Effect]) -> Iterator[Effect]:
    """Effects, and behind each scale and mount one that sets in at one time."""
    for effect in effects:
        yield effect
        if effect.name in SETTING_IN:
            yield _from_one_time_on(effect)


def _from_one_time_on(whole: Effect) -> Effect:
    """A scale error that sets in, or a mount that slips: its size, then the time (s from the log's start)."""
    if whole.name == mount_rotation.EFFECT.name:
        return replace(mount_rotation.slipping(T_STEP), variant=STEP)
    sensor: Sensor = "gyro" if whole.sensors == ("gyro",) else "accel"

    def forward(samples: SensorSamples, theta: Theta) -> SensorSamples:
        on = np.asarray(samples.stamp_s >= theta[3])[:, None]
        return samples.with_added(sensor, on * theta[:3] * getattr(samples, sensor))

    def starts(motion: IdealMotion, samples: SensorSamples) -> list[Theta]:
        """The likeliest time at which the scale changes, after what most other errors follow."""
        ideal, t_s = motion.sample(samples.stamp_s, samples.stamp_s), samples.stamp_s
        error = residual(motion, samples)[SENSORS.index(sensor)]
        others = np.column_stack([np.ones(len(t_s)), followed(ideal)])
        return [likeliest_onset(t_s, error, others, setting_in=getattr(ideal, sensor))]

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


SCALES = ("gyro_scale", "accel_scale")
SETTING_IN = (*SCALES, mount_rotation.EFFECT.name)
EFFECT = scale("gyro", "omega", 0.1, "the axis turns")
