"""Delay of the gyro against the accelerometer, from the filters of one chip.

What delays both is a `clock_offset`. Only a motion that both sensors see tells the two apart. The delay turns the phases of
a spectrum: a spline between samples would take a twelfth from a vibration at a third of the sample rate.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from imutool.array_types import Float64
from imutool.sensor.effect import Effect, Parameter, Stage, Theta, starts_at
from imutool.sensor.samples import IdealMotion


def _forward(motion: IdealMotion, tau_s: Theta) -> IdealMotion:
    samples = float(tau_s[0]) * motion.rate_hz
    if samples == 0.0:
        return motion
    return replace(motion, gyro=np.stack([_delayed(column, samples) for column in motion.gyro.T]).T)


def _delayed(x: Float64[np.ndarray, " n"], samples: float) -> Float64[np.ndarray, " n"]:
    """A column some samples later, mirrored at its ends without the ramp between them."""
    from scipy.fft import irfft, rfft, rfftfreq

    ramp = np.linspace(x[0], x[-1], n := len(x))
    mirrored = np.concatenate([x - ramp, (ramp - x)[-2:0:-1]])
    spectrum = rfft(mirrored)
    turn = np.exp(-2j * np.pi * rfftfreq(len(mirrored)) * samples)
    slope = (x[-1] - x[0]) / max(n - 1, 1)
    return np.asarray(ramp - slope * samples + irfft(spectrum * turn, len(mirrored))[:n])


EFFECT = Effect(
    "gyro_delay",
    Stage.BANDWIDTH,
    ("gyro",),
    "gyro(t) = omega(t - tau)",
    (Parameter("tau", "s", 0.005),),
    "it turns, and the accelerometer shows the clock",
    _forward,
    linear=False,
    starts=starts_at([0.0]),
)
