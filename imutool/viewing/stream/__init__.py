"""Live streams of samples: sources, messages, the session, and its statistics."""

from __future__ import annotations

from imutool.bias_start import Fitness
from imutool.report import Section


class Delay(Section, frozen=True):
    """Delay from a sample's arrival to its corrected value, in ms, after the start."""

    median: float
    p99: float
    max: float


class StreamStatistics(Section, frozen=True):
    """Statistics of a live stream.

    `start` says where the initial bias comes from, `fit` whether the model fits.
    """

    samples: int
    seconds: float
    rate_hz: float
    delay_ms: Delay | None
    start: str
    fit: Fitness | None
    gaps: int
    out_of_order: int
    not_measured: int
    malformed: int
    not_shown: int
    gyro_bias: list[float]
    accel_bias: list[float]
