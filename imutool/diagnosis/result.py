"""What `diagnose` says: where a simulation and a recording differ, what was left out, how sure that is, and what it brings.

`Diagnosis.plain` is the JSON of contracts.md (`imutool.diagnosis/1`); the traces beside it are for pictures.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float64

from imutool.recording import Poses
from imutool.units import ASCII_UNITS

SCHEMA = "imutool.diagnosis/1"
WORTH = 0.1  # of the noise, in power, that a misfit must have for a share of it to mean anything


@dataclass(frozen=True)
class Located:
    """Where the misfit lies: axes of a signal, stretches of time (s from the start of the log), and in which regime.

    `share` is how much of that signal's misfit above the noise lies there; `p_value` is that of noise alone doing the same.
    `log` is which of several it is, as `Diagnosis.real` has it.
    """

    signal: str
    axes: tuple[str, ...]
    intervals_s: tuple[tuple[float, float], ...]
    regime: str
    share: float
    p_value: float
    log: str = ""


@dataclass(frozen=True)
class Estimate:
    """A parameter with its standard deviation."""

    value: float
    std: float
    unit: str


@dataclass(frozen=True)
class HeldOut:
    """Root mean square of the residual over time that no fit has seen, before and after the effect was modelled."""

    rms_before: float
    rms_after: float
    unit: str
    seconds: float


@dataclass(frozen=True)
class Closer(HeldOut):
    """As `HeldOut` for all findings together; `share` of the misfit above the noise is gone, in power (none where none was).

    `by` a second simulation with what was found on the other time, or as the search computes it.
    """

    share: float | None = None
    by: Literal["second simulation", "computed"] = "computed"

    @classmethod
    def of(cls, one: HeldOut, noise_floor: float) -> Closer:
        """As it is computed, over noise of some root mean square."""
        misfit = one.rms_before**2 - noise_floor**2
        gone = None
        if misfit > WORTH * noise_floor**2:
            gone = max(-1.0, min(1.0, (one.rms_before**2 - one.rms_after**2) / misfit))
        return cls(one.rms_before, one.rms_after, one.unit, one.seconds, gone)


@dataclass(frozen=True, eq=False)
class Curve:
    """A misfit without a name as a curve of one variable: values about their mean, with a band (one standard deviation).

    The mean, which no motion tells from a bias, is apart.
    """

    variable: str
    unit: str
    x: Float64[np.ndarray, " k"]
    y: Float64[np.ndarray, "k axes"]
    band: Float64[np.ndarray, "k axes"]
    mean: float = 0.0


@dataclass(frozen=True)
class Finding:
    """An effect of the catalogue, `driven` (by the channel `driver`), or `unknown`.

    `share`: of the signal's misfit above the noise, what it removes on held-out time. `similar`: what cannot be told from it.
    """

    effect: str
    signal: str
    share: float
    p_value: float
    false_discovery_rate: float
    parameters: Mapping[str, Estimate]
    equation: str
    held_out: HeldOut
    driver: str = ""
    similar: tuple[str, ...] = ()
    curve: Curve | None = None


@dataclass(frozen=True)
class Unexplained:
    """What is left of a signal: its root mean square, the noise's, and whether it looks like noise."""

    rms: float
    noise_floor: float
    white: bool


@dataclass(frozen=True, eq=False)
class Traces:
    """One log, for pictures: gyro (rad/s) and accel (m/s²), what was expected before and after, which samples were held out."""

    log: str
    t_s: Float64[np.ndarray, " n"]
    real: Float64[np.ndarray, "n 6"]
    before: Float64[np.ndarray, "n 6"]  # the simulation and a constant bias
    after: Float64[np.ndarray, "n 6"]  # with the findings modelled
    held_out: Bool[np.ndarray, " n"]
    truth: Poses | None = None  # at these samples
    ideal: Float64[np.ndarray, "n 6"] | None = None  # what a perfect sensor would have read
    band_hz: float | None = None  # above it what was expected is not known
    path: str = ""  # of the log, as `Diagnosis.real` has it


@dataclass(frozen=True, eq=False)
class SignalTraces:
    """One other signal, for pictures: what was recorded, what was expected before and after, which samples were held out."""

    t_s: Float64[np.ndarray, " n"]
    real: Float64[np.ndarray, " n"]
    before: Float64[np.ndarray, " n"]
    after: Float64[np.ndarray, " n"]
    held_out: Bool[np.ndarray, " n"]
    unit: str


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """The answer. Findings come strongest first; `bias` is each log's own constant, that of the first log in the JSON."""

    real: tuple[str, ...]
    sim: str | None
    located: tuple[Located, ...]
    findings: tuple[Finding, ...]
    bias: Float64[np.ndarray, "logs 6"]
    not_identifiable: tuple[str, ...]
    unexplained: Mapping[str, Unexplained]
    remarks: tuple[str, ...] = ()
    closer: Mapping[str, Closer] = field(default_factory=dict)  # of each signal, once simulated again with the findings
    traces: tuple[Traces, ...] = ()
    signals: Mapping[str, SignalTraces] = field(default_factory=dict)  # by TOPIC.field

    @property
    def mismatch(self) -> bool:
        """Whether more than a constant bias and noise separates the two."""
        return bool(self.findings) or bool(self.located)

    def plain(self) -> dict[str, Any]:
        """As JSON has it; nothing is said of what is left of a sensor that told nothing."""
        left = dict.fromkeys(ASCII_UNITS) | dict(self.unexplained)
        return {
            "schema": SCHEMA,
            "real": list(self.real),
            "sim": self.sim,
            "mismatch": self.mismatch,
            "located": [_located(one) for one in self.located],
            "findings": [_finding(one) for one in self.findings],
            "bias": _bias(self.bias[0]),
            "biases": [_bias(one) for one in self.bias],
            "not_identifiable": list(self.not_identifiable),
            "unexplained": {
                **{f"{name}_rms": None if one is None else one.rms for name, one in left.items()},
                "noise_floor": {name: None if one is None else one.noise_floor for name, one in left.items()},
                "white": all(one.white for one in self.unexplained.values()),
            },
            "closer": {name: _held_out(one) | {"share": one.share, "by": one.by} for name, one in self.closer.items()},
            "remarks": list(self.remarks),
        }


def _bias(one: Float64[np.ndarray, "6"]) -> dict[str, Any]:
    """Nothing where nobody knows it."""
    parts = {"gyro": one[:3], "accel": one[3:]}
    return {signal: part.tolist() if np.isfinite(part).all() else None for signal, part in parts.items()}


def _located(one: Located) -> dict[str, Any]:
    out = {
        "signal": one.signal,
        "axes": list(one.axes),
        "intervals_s": [list(interval) for interval in one.intervals_s],
        "regime": one.regime,
        "share": one.share,
        "p_value": one.p_value,
    }
    return out | {"log": one.log} if one.log else out


def _finding(one: Finding) -> dict[str, Any]:
    out: dict[str, Any] = {
        "effect": one.effect,
        "signal": one.signal,
        "share": one.share,
        "p_value": one.p_value,
        "false_discovery_rate": one.false_discovery_rate,
        "parameters": {name: {"value": e.value, "std": e.std, "unit": e.unit} for name, e in one.parameters.items()},
        "equation": one.equation,
        "held_out": _held_out(one.held_out),
    }
    if one.driver:
        out["driver"] = one.driver
    if one.similar:
        out["similar"] = list(one.similar)
    if one.curve is not None:
        curve = one.curve
        out["curve"] = {"variable": curve.variable, "unit": curve.unit}
        out["curve"] |= {"x": curve.x.tolist(), "y": curve.y.tolist(), "band": curve.band.tolist()}
    return out


def _held_out(one: HeldOut) -> dict[str, Any]:
    return {"rms_before": one.rms_before, "rms_after": one.rms_after, "unit": one.unit, "seconds": one.seconds}
