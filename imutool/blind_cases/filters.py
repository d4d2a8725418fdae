"""Linear systems on an even clock, integrated exactly for inputs that are straight lines between samples."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.signal import cont2discrete, lfilter, lfilter_zi

Columns = Float64[np.ndarray, "n k"]


def first_order(signal: Columns, rate_hz: float, cut_off_hz: float) -> Columns:
    """H = 1 / (1 + s / (2 pi f_c)), from a steady state."""
    w = 2.0 * np.pi * cut_off_hz
    return _through(signal, rate_hz, [w], [1.0, w])


def mount(signal: Columns, rate_hz: float, f0_hz: float, zeta: float) -> Columns:
    """What sits on a spring and damper accelerates by H = (2 zeta w s + w²) / (s² + 2 zeta w s + w²) of what its base does."""
    w = 2.0 * np.pi * f0_hz
    return _through(signal, rate_hz, [2.0 * zeta * w, w * w], [1.0, 2.0 * zeta * w, w * w])


def _through(signal: Columns, rate_hz: float, numerator: list[float], denominator: list[float]) -> Columns:
    system: Any = (numerator, denominator)  # the stubs know five kinds of numbers, and no list of floats
    top, bottom, _ = cont2discrete(system, 1.0 / rate_hz, method="foh")
    b, a = np.ravel(top), np.ravel(bottom)
    start = lfilter_zi(b, a)[:, None] * signal[:1]
    out: Columns = np.asarray(lfilter(b, a, signal, axis=0, zi=start)[0])
    return out
