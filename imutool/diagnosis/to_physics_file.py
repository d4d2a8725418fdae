"""The physics that a diagnosis found, as a physics.toml says it: what `simulate` adds and `debias` takes off.

Left out is what is no effect on a reading: samples that are missing, stamps that jitter, a reference that is wrong. Findings
with nothing finite to say of themselves are left out as well.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Literal

import numpy as np
from jaxtyping import Float64

from imutool.diagnosis.result import Diagnosis, Estimate, Finding
from imutool.sensor.physics_file import Bias, Curve, Entry, PhysicsFile, Term, Three, Value
from imutool.sensor.unnamed_effects import DRIVEN
from imutool.units import AXES, Sensor

NO_EFFECT = frozenset({"dropped_samples", "timestamp_jitter", "reference_error"})
UNKNOWN = "unknown"
ON_AXIS = re.compile(r"(gyro|accel)\.([xyz]) \+= (?:c (?P<term>.+)|curve\(.+\))")  # as unnamed_effects writes it


def found(d: Diagnosis) -> PhysicsFile:
    """What was found, and the constant bias of the first log beside it, if it is known.

    A curve without a name is told about its mean; the mean belongs to the bias, and is added to it.
    """
    entries, curves, terms = [], [], []
    bias = np.array(d.bias[0], dtype=np.float64)
    for one in d.findings:
        if one.effect in NO_EFFECT:
            continue
        if one.effect != UNKNOWN:
            values = _values(one.parameters)
            if values:
                entries.append(
                    Entry(
                        name=one.effect,
                        signal=_signal(one.signal),
                        driver=one.driver if one.effect == DRIVEN else "",
                        equation=one.equation,
                        parameters=values,
                    )
                )
        elif one.curve is not None:
            curves.append(_curve(one))
            bias += _mean_of_curve(one)
        else:
            terms.append(_term(one))
    return PhysicsFile(
        effect=tuple(entries),
        bias=Bias(gyro=_three(bias[:3]), accel=_three(bias[3:])) if np.isfinite(bias).all() else None,
        unknown=tuple(curves),
        term=tuple(terms),
    )


def _values(parameters: Mapping[str, Estimate]) -> dict[str, Value]:
    """What is infinite is not there: a limit or a cut-off that is never reached."""
    return {
        name: Value(value=float(e.value), std=float(e.std) if math.isfinite(e.std) else None, unit=e.unit)
        for name, e in parameters.items()
        if math.isfinite(e.value)
    }


def _curve(one: Finding) -> Curve:
    assert one.curve is not None
    sensor, _, _ = _place(one)
    curve = one.curve
    return Curve(
        signal=sensor,
        variable=curve.variable,
        unit=curve.unit,
        x=tuple(curve.x.tolist()),
        y=tuple(_three(row) for row in curve.y),
        band=tuple(_three(row) for row in curve.band),
    )


def _mean_of_curve(one: Finding) -> Float64[np.ndarray, "6"]:
    """What the curve is on average, on its axis."""
    assert one.curve is not None
    sensor, axis, _ = _place(one)
    out = np.zeros(6)
    out[3 * (sensor == "accel") + axis] = one.curve.mean
    return out


def _term(one: Finding) -> Term:
    sensor, axis, text = _place(one)
    (c,) = one.parameters.values()
    value, std = np.zeros(3), np.zeros(3)
    value[axis], std[axis] = c.value, c.std if math.isfinite(c.std) else 0.0
    return Term(signal=sensor, term=text, value=_three(value), std=_three(std))


def _place(one: Finding) -> tuple[Sensor, int, str]:
    """Sensor, axis and term of what has no name: its equation says it."""
    match = ON_AXIS.fullmatch(one.equation)
    assert match is not None, f"an unknown finding's equation: {one.equation}"
    sensor: Sensor = "gyro" if match[1] == "gyro" else "accel"
    return sensor, AXES.index(match[2]), match["term"] or ""


def _signal(signal: str) -> Literal["gyro", "accel", "both", ""]:
    """Where an effect acts; what has another name says it by acting."""
    match signal:
        case "gyro" | "accel" | "both":
            return signal
        case _:
            return ""


def _three(values: Float64[np.ndarray, "3"]) -> Three:
    x, y, z = (float(value) for value in values)
    return x, y, z
