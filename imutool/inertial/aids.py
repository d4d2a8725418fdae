"""Aids of an IMU: stops, barometer, wheel odometry, and ground contact."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from imutool.array_types import Float64
from imutool.errors import ConfigError, did_you_mean
from imutool.recording import Poses, Scalars

STOPS, BAROMETER, WHEELS, GROUND = KINDS = ("stops", "barometer", "odometry", "ground")
AUTO = "auto"


@dataclass(frozen=True)
class Odometry:
    """Poses of a vehicle with velocity; R_vb turns the IMU's vectors to the vehicle's frame."""

    poses: Poses
    R_vb: Float64[np.ndarray, "3 3"]
    std_rad: float


@dataclass(frozen=True)
class Aids:
    """Aids of one stretch of a log; `signals` states the topic, and a height's unit, by kind."""

    signals: dict[str, str]
    height: Scalars | None = None
    odometry: Odometry | None = None


def listed(signals: Mapping[str, str]) -> str:
    """Kinds of aids with what measures them, for a sentence."""
    return ", ".join(f"{kind} {signal}".strip() for kind, signal in signals.items())


def parse_aids(words: str) -> dict[str, str]:
    """Topic by kind, of words such as `stops,barometer=/baro`; empty: to be searched for.

    Raises:
        ConfigError: an unknown kind.
    """
    asked = dict[str, str]()
    for word in words.split(","):
        kind, _, topic = word.strip().partition("=")
        is_known = kind in (*KINDS, AUTO)
        if not is_known or (topic and kind not in (BAROMETER, WHEELS)):
            fix = f"Only {BAROMETER} and {WHEELS} take a topic" if is_known else did_you_mean(kind, KINDS)
            raise ConfigError(f"aid {word!r}", where="aid", expected=f"auto, or some of {', '.join(KINDS)}", fix=fix)
        asked[kind] = topic
    return asked
