"""How large an effect is when it is drawn: at the plausible size of the catalogue, some by rules of their own."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float64
from numpy.random import Generator

from imutool.blind_cases.effects import ACCEL, GYRO, NO_LIMIT, Model, Six, Theta, clipping

Sigma = Float64[np.ndarray, "6"]


def drawn(model: Model, rng: Generator, signal: Six, noise: Sigma, duration_s: float) -> Theta:
    """Parameters at the plausible size.

    Amounts are Gaussian with a root mean square of one plausible size, every second time on a single axis; the rest is spread
    over what the catalogue calls plausible.
    """
    if model.name in _SPECIAL:
        return _SPECIAL[model.name](rng, signal, noise, duration_s)
    amounts = model.amounts
    theta = model.plausible * np.where(amounts, rng.standard_normal(len(amounts)), 1.0)
    count = int(amounts.sum())
    parts = {"gravity": 1, "temperature": 2}.get(model.name, 3)  # one row of a matrix, one axis, one sensor
    if count % parts == 0 and rng.random() < 0.5:
        kept = np.zeros(count, dtype=bool)
        kept[rng.integers(parts) * (count // parts) :][: count // parts] = True
        theta[amounts] *= kept
    if model.name == "size_effect":  # what is common to all three axes would be a lever arm
        theta -= np.tile(theta.reshape(3, 3).mean(axis=0), 3)
    if not amounts.all():
        theta[~amounts] = rng.uniform(0.1, 0.4) * duration_s  # time constants of the drifts
    used = theta[amounts] / model.plausible[amounts]
    theta[amounts] /= np.sqrt(np.mean(used[used != 0.0] ** 2))
    return theta


def _one_of(rng: Generator, values: float) -> Theta:
    return np.array([values * rng.choice([-1.0, 1.0])])


def _draw_line(rng: Generator, signal: Six, noise: Sigma, duration_s: float) -> Theta:
    which = rng.choice(3, p=[0.2, 0.6, 0.2])
    amplitude = np.abs(rng.standard_normal(6)) + 0.2
    amplitude[GYRO] *= 0.1 * (which != 1)
    amplitude[ACCEL] *= 1.0 * (which != 0)
    return np.concatenate([[rng.uniform(15.0, 80.0)], amplitude, rng.uniform(0.0, 2.0 * np.pi, 6)])


def _draw_resonance(rng: Generator, signal: Six, noise: Sigma, duration_s: float) -> Theta:
    share = np.ones(3) if rng.random() < 0.4 else rng.permutation([1.0, rng.uniform(0.0, 0.5), 0.0])
    return np.array([np.exp(rng.uniform(np.log(3.0), np.log(30.0))), rng.uniform(0.05, 0.4), *share])


def _draw_limits(rng: Generator, signal: Six, noise: Sigma, duration_s: float) -> Theta:
    """Which sensor clips; `clipping` says where."""
    which = rng.choice(3, p=[0.4, 0.4, 0.2])
    return clipping(np.array([NO_LIMIT * (which == 1), NO_LIMIT * (which == 0)]), 1.0, signal)


def _draw_lsb(rng: Generator, signal: Six, noise: Sigma, duration_s: float) -> Theta:
    """Eight standard deviations of the noise."""
    which = rng.choice(3)
    return 8.0 * np.array([noise[0] * (which != 1), noise[3] * (which != 0)])


def _draw_gaps(rng: Generator, signal: Six, noise: Sigma, duration_s: float) -> Theta:
    starts = (np.arange(3) + rng.uniform(0.2, 0.7, 3)) * duration_s / 3.0
    return np.array([2.0, *starts])


_SPECIAL: Mapping[str, Callable[[Generator, Six, Sigma, float], Theta]] = {
    "clock_offset": lambda rng, *_: _one_of(rng, 0.05),
    "clock_skew": lambda rng, *_: _one_of(rng, 1e-3),
    "clock_jump": lambda rng, signal, noise, span: np.array([rng.uniform(0.25, 0.75) * span, *_one_of(rng, 0.05)]),
    "low_pass": lambda rng, *_: np.array([rng.uniform(4.0, 6.0)]),
    "saturation": _draw_limits,
    "quantization": _draw_lsb,
    "vibration": _draw_line,
    "mount_resonance": _draw_resonance,
    "earth_rotation": lambda rng, *_: np.array([rng.uniform(-1.2, 1.2), rng.uniform(-3.0, 3.0)]),
    "dropped_samples": lambda rng, *_: np.array([0.02]),
    "timestamp_jitter": lambda rng, *_: np.array([2e-3]),
    "reference_error": _draw_gaps,
}
