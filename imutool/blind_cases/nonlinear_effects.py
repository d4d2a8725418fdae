"""Forward models of nonlinear readings: bent, of two gains, with a dead band, with play."""

from __future__ import annotations

import numpy as np

from imutool.blind_cases.effects import Theta, Three, Times


def quadratic(values: Three, k: Theta, t_s: Times) -> Three:
    """(1 + k v) v."""
    return np.asarray(values * (1.0 + k * values))


def two_gains(values: Three, a: Theta, t_s: Times) -> Three:
    """(1 + a / 2) v where v is positive, (1 - a / 2) v where it is negative."""
    return np.where(values > 0.0, values * (1.0 + 0.5 * a), values * (1.0 - 0.5 * a))


def dead_band(values: Three, width: Theta, t_s: Times) -> Three:
    """Zero below the width."""
    return np.where(np.abs(values) < width[0], 0.0, values)


def play(values: Three, width: Theta, t_s: Times) -> Three:
    """What a reading is dragged along by, with so much play on both sides."""
    out, dragged = np.empty_like(values), values[0]
    for k, value in enumerate(values):
        dragged = np.minimum(np.maximum(dragged, value - width[0]), value + width[0])
        out[k] = dragged
    return out
