"""Curve of each axis's own rate, for unnamed gyro errors: + c(omega) + d(omega, filtered).

Piecewise linear between knots that lie closer near zero, where cheap gyros have dead bands and signs; zero at zero, so that the
rest bias stays what the sensor reads at rest. The second curve sees the rate through a filter of 0.1 s, for sensors whose
correction lags their motion. It can imitate any other effect on the rate, so that a diagnosis does not look for it.
"""

from __future__ import annotations

from bisect import bisect_right

import numpy as np

from imutool.array_types import Float64, Vectors
from imutool.sensor.effect import CompiledEffect, Effect, Parameter, Stage, Theta
from imutool.sensor.samples import SensorSamples
from imutool.sensor.signals import GYRO, GYRO_SLOW, Signals
from imutool.units import AXES, Three

POSITIVE_RAD_S = (0.03, 0.1, 0.25, 0.5, 1.0, 2.0, 4.0)
KNOTS_RAD_S = np.array([*(-k for k in reversed(POSITIVE_RAD_S)), 0.0, *POSITIVE_RAD_S])
NONZERO = KNOTS_RAD_S != 0.0


def _forward(samples: SensorSamples, theta: Theta) -> SensorSamples:
    return samples.with_readings(gyro=samples.gyro + _curves(samples.signals, _values(theta)))


def _values(theta: Theta) -> Float64[np.ndarray, "2 3 k"]:
    """Values at the knots, of c and d, by axis."""
    values = np.zeros((2, 3, len(KNOTS_RAD_S)))
    values[:, :, NONZERO] = theta.reshape(2, 3, -1)
    return values


def _curves(signals: Signals, values: Float64[np.ndarray, "2 3 k"]) -> Vectors:
    columns = zip((*signals.gyro.T, *signals.gyro_slow.T), values.reshape(6, -1), strict=True)
    both = [np.interp(x, KNOTS_RAD_S, value) for x, value in columns]
    return np.stack([a + b for a, b in zip(both[:3], both[3:], strict=True)], axis=1)


def hats(x: Vectors) -> Float64[np.ndarray, "n q"]:
    """Tent functions of all knots but zero, axis by axis; constant beyond the last knot."""
    inside = np.clip(x, KNOTS_RAD_S[0], KNOTS_RAD_S[-1])
    j = np.clip(np.searchsorted(KNOTS_RAD_S, inside, side="right") - 1, 0, len(KNOTS_RAD_S) - 2)
    weight = (inside - KNOTS_RAD_S[j]) / (KNOTS_RAD_S[j + 1] - KNOTS_RAD_S[j])
    out = np.zeros((len(x), 3, len(KNOTS_RAD_S)))
    np.put_along_axis(out, j[..., None], (1.0 - weight)[..., None], axis=2)
    np.put_along_axis(out, j[..., None] + 1, weight[..., None], axis=2)
    return out[:, :, NONZERO].reshape(len(x), -1)


def _basis(signals: Signals) -> Float64[np.ndarray, "n q"]:
    return np.concatenate([hats(signals.gyro), hats(signals.gyro_slow)], axis=1)


def _fast(theta: Theta) -> CompiledEffect:
    """The curves; for one sample each is a line that is looked up."""
    values = _values(theta)
    slope = np.pad(np.diff(values) / np.diff(KNOTS_RAD_S), ((0, 0), (0, 0), (1, 1)))  # level beyond the last knots
    at_zero = np.pad(values, ((0, 0), (0, 0), (1, 0)), mode="edge") - slope * np.pad(KNOTS_RAD_S, (1, 0), mode="edge")
    knots, lines = KNOTS_RAD_S.tolist(), np.stack([at_zero, slope], axis=-1).reshape(6, -1, 2).tolist()

    def one(_: float, row: list[float]) -> Three:
        seen = zip(lines, row[GYRO] + row[GYRO_SLOW], strict=True)
        e = [(segment := line[bisect_right(knots, x)])[0] + segment[1] * x for line, x in seen]
        return e[0] + e[3], e[1] + e[4], e[2] + e[5]

    return CompiledEffect(lambda signals: _curves(signals, values), one)


EFFECT = Effect(
    "rate_curve",
    Stage.SENSOR,
    ("gyro",),
    "gyro += c(omega) + d(omega filtered)",
    tuple(
        Parameter(f"{kind}{axis}{knot:+g}", "rad/s", 0.01)
        for kind in ("", "slow_")
        for axis in AXES
        for knot in KNOTS_RAD_S[NONZERO]
    ),
    "the axis turns at the knot's rate",
    _forward,
    trained=True,
    diagnosed=False,
    basis=_basis,
    fast=_fast,
)
