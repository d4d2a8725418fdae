"""Sensor files of a diagnosis: the physics (physics.toml) and the noise (noise.toml).

Missing samples, jittering stamps and a wrong reference are no effects of a sensor and are left out of the physics, as are
findings without a finite parameter. The noise is the samples of the recording less those expected with all findings: noise of
the sensor, vibration, and the motion that the reference does not know. A twin of the sensor has them all.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Literal

import numpy as np

from imutool.diagnosis.estimation.jacobians import Chosen
from imutool.diagnosis.estimation.trial.effect_forms import low_pass_with
from imutool.diagnosis.result import CONVENTIONS, Diagnosis, Estimate, Finding
from imutool.noise.colour import measured
from imutool.noise.datasheet import Noise
from imutool.sensor.effect import Effect, Theta
from imutool.sensor.physics_file import Bias, Curve, Entry, PhysicsFile, Term, Value
from imutool.units import AXES, SENSORS, Sensor, three

NO_EFFECT = CONVENTIONS | {"dropped_samples", "timestamp_jitter", "reference_error", "reference_smoothing"}


NONE = Estimate(math.nan, math.nan, "")


def start_values(findings: Sequence[Finding], candidates: Sequence[Effect]) -> Chosen:
    """Candidates that were found, strongest first, with the values of the first finding of each."""
    found = dict[str, tuple[Effect, Theta]]()
    for finding in findings:
        alike = [effect for effect in candidates if effect.name == finding.effect and finding.effect not in NO_EFFECT]
        alike = [effect for effect in alike if effect.key not in found]  # what acts once more has a finding of its own
        effect = max(alike, key=partial(_likeness, finding), default=None)
        if effect is not None:
            found[effect.key] = _started(effect, finding.parameters)
    return tuple(found.values())


def _likeness(finding: Finding, effect: Effect) -> tuple[bool, bool, int, int]:
    """How alike an effect of the name of a finding is: its constants, sensor, how many constants agree, and parameters."""
    agree = all(finding.parameters.get(of.name, NONE).value == value for of, value in effect.constants)
    known = sum(of.name in finding.parameters for of in effect.parameters)
    return agree, effect.sensors == (finding.signal,), len(effect.constants), known


def _started(effect: Effect, parameters: Mapping[str, Estimate]) -> tuple[Effect, Theta]:
    """An effect with found values; a low-pass is digital, or smoothing, if its rate was found."""
    effect = low_pass_with(effect, parameters) if effect.lagless is not None else effect
    values = [parameters[of.name].value if of.name in parameters else of.null_value for of in effect.parameters]
    return effect, np.array(values)


def to_physics_file(d: Diagnosis) -> PhysicsFile:
    """Physics file with the findings and, if known, the first log's bias (plus curves' means)."""
    entries, curves, terms = [], [], []
    bias = np.array(d.bias[0], dtype=np.float64)
    for finding in d.findings:
        if finding.effect in NO_EFFECT:
            continue
        if finding.kind == "unknown":
            sensor = _sensor(finding.signal)
            if sensor is None:
                continue  # a curve of another signal than the IMU's
            if finding.curve is None:
                terms.append(_term(finding, sensor))
            else:
                curves.append(_curve(finding, sensor))
                bias[3 * (sensor == "accel") + _column(finding)] += finding.curve.mean
        elif values := _values(finding.parameters):
            entries.append(
                Entry(
                    name=finding.effect,
                    signal=_signal(finding.signal),
                    driver=finding.driver,
                    column="" if _signal(finding.signal) else finding.signal,
                    equation=finding.equation,
                    parameters=values,
                )
            )
    return PhysicsFile(
        start_ns=d.start_ns,
        conventions=tuple(dict.fromkeys(finding.effect for finding in d.findings if finding.effect in CONVENTIONS)),
        effect=tuple(entries),
        bias=Bias(gyro=three(bias[:3]), accel=three(bias[3:])) if np.isfinite(bias).all() else None,
        unknown=tuple(curves),
        term=tuple(terms),
    )


def _values(parameters: Mapping[str, Estimate]) -> dict[str, Value]:
    """Leaves out infinite values: a limit or a cut-off that is never reached."""
    return {
        name: Value(value=float(e.value), std=float(e.std) if math.isfinite(e.std) else None, unit=e.unit)
        for name, e in parameters.items()
        if math.isfinite(e.value)
    }


def _curve(finding: Finding, sensor: Sensor) -> Curve:
    assert finding.curve is not None
    curve = finding.curve
    return Curve(
        signal=sensor,
        variable=curve.variable,
        unit=curve.unit,
        x=curve.x,
        y=tuple(three(np.array(row)) for row in curve.y),
        band=tuple(three(np.array(row)) for row in curve.band),
    )


def _term(finding: Finding, sensor: Sensor) -> Term:
    axis = _column(finding)
    (c,) = finding.parameters.values()
    value, std = np.zeros(3), np.zeros(3)
    value[axis], std[axis] = c.value, c.std if math.isfinite(c.std) else 0.0
    return Term(signal=sensor, term=finding.variable, value=three(value), std=three(std))


def _column(finding: Finding) -> int:
    assert finding.axis is not None, f"an unknown effect of {finding.signal} has an axis"
    return AXES.index(finding.axis)


def _sensor(signal: str) -> Sensor | None:
    match signal:
        case "gyro" | "accel":
            return signal
        case _:
            return None


def _signal(signal: str) -> Literal["gyro", "accel", "both", ""]:
    """Signal of a physics file; empty for any other signal of the log."""
    return "both" if signal == "both" else _sensor(signal) or ""


def to_noise_file(d: Diagnosis) -> Noise | None:
    """Noise with its colour, of all logs; None without samples of an IMU that vary."""
    if not d.traces:
        return None
    rate_hz = 1.0 / float(np.median([np.median(np.diff(trace.t_s)) for trace in d.traces]))
    std = np.nanstd(np.concatenate([trace.real - trace.after for trace in d.traces]), axis=0)
    if not (std > 0.0).all():
        return None
    names = ", ".join(dict.fromkeys(trace.log for trace in d.traces))
    return Noise(
        gyro_density=three(std[:3] / np.sqrt(rate_hz)),
        accel_density=three(std[3:] / np.sqrt(rate_hz)),
        sources={f"{sensor}_density": f"what the findings leave of {names}" for sensor in SENSORS},
        colour=measured([(trace.t_s, trace.real, trace.after) for trace in d.traces], std, rate_hz),
    )
