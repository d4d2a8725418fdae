"""Gain of findings: the share of the concealed misfit that they explain.

`explained_gain` simulates the true and the found effects along the simulation's own poses, both without noise, by the forward
models of this room. `reported_gain` trusts the residuals that the findings report.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from msgspec import Struct
from scipy.interpolate import make_interp_spline

from imutool.blind_cases import catalogue
from imutool.blind_cases.catalogue import AXES, CATALOGUE
from imutool.blind_cases.effects import Model, Stage, Theta
from imutool.blind_cases.envelope import ConcealedTruth, Rms
from imutool.blind_cases.motion import DEGREE, Motion, smoother
from imutool.blind_cases.scene import RATE_HZ, Scene
from imutool.recording import Recording, seconds

EDGE_S = 1.0  # at both ends, where filters settle and shifted clocks leave the log
WITHOUT_MISFIT = {"quantization", "dropped_samples", "timestamp_jitter"}  # act on noise and stamps
NOT_SIMULATED = {"reference_error", "vibration", "unknown"}  # their parameters alone do not say the signal
MIN_MISFIT = 0.02  # of the noise's power: with less than that a signal has no gain worth a ratio
SIGNALS = ("gyro", "accel")
BOTH = ("both", "imu")


class ReportedValue(Struct):
    """Value of a parameter that a finding reports; None where it is infinite or unknown."""

    value: float | None
    std: float | None


class ReportedRms(Struct):
    """Residual that a report gives before and after its findings."""

    rms_before: float | None
    rms_after: float | None


class ReportedFinding(Struct):
    """Finding of a report, as far as it is scored."""

    effect: str
    signal: str
    parameters: dict[str, ReportedValue]
    held_out: ReportedRms
    driver: str = ""
    equation: str = ""


class ReportedLocation(Struct):
    """Location that a report gives for a misfit."""

    signal: str
    axes: list[str]
    intervals_s: list[tuple[float, float]]


class ReportedNoise(Struct):
    """Noise floors that a report gives, by signal."""

    noise_floor: dict[str, float | None]


class Findings(Struct):
    """Report of `diagnose` (imutool.diagnosis/1), as far as it is scored."""

    mismatch: bool | None
    located: list[ReportedLocation]
    findings: list[ReportedFinding]
    unexplained: ReportedNoise
    closer: dict[str, ReportedRms] = {}


def explained_gain(
    truth: ConcealedTruth, found: Sequence[tuple[ReportedFinding, Mapping[str, float]]], sim: Recording
) -> float | None:
    """Share of the misfit's power over the noise that findings explain.

    Their parameters have the catalogue's names. At most 1; below 0 where they make it worse. None where an effect cannot be
    simulated, there is none, or what is concealed acts within `EDGE_S` of the ends alone, as a limit that the first second
    reaches.
    """
    shown = [effect for effect in truth.effects if effect.effect not in WITHOUT_MISFIT]
    known = [_model(e.effect, e.driver, e.equation, {k: p.value for k, p in e.parameters.items()}) for e in shown]
    acting = [_model(f.effect, f.driver, f.equation, theta) for f, theta in found if f.effect not in WITHOUT_MISFIT]
    if not known or None in known or None in acting:
        return None
    scene = _scene(truth, sim)
    t_s = scene.t_s
    inner = (t_s >= EDGE_S) & (t_s <= t_s[-1] - EDGE_S)

    def power(some: Sequence[Any], other: Sequence[Any]) -> float:
        difference = (scene.misfit(some, t_s) - scene.misfit(other, t_s))[inner]
        return float(np.sum(((difference - difference.mean(axis=0)) / scene.sigma) ** 2))

    concealed = power(known, [])
    return float(np.clip(1.0 - power(known, acting) / concealed, -1.0, 1.0)) if concealed else None


def _model(name: str, driver: str, equation: str, values: Mapping[str, float]) -> tuple[Model, Theta] | None:
    """Forward model with its parameters; a missing amount is zero, any other missing parameter gives None."""
    if name == "driven":
        sensor, _, axis = equation.partition(" ")[0].partition(".")
        topic = next((topic for topic in catalogue.TOPICS if driver == topic or driver.startswith(f"{topic}.")), None)
        if topic is None or sensor not in SIGNALS or axis not in AXES or not {"gain", "lag"} <= set(values):
            return None
        return catalogue.follower(topic, AXES.index(axis) + 3 * (sensor == "accel")), np.array([values["gain"], values["lag"]])
    if name in NOT_SIMULATED or name not in CATALOGUE or (name == "low_pass" and "f_c" not in values):
        return None
    model = CATALOGUE[name]
    missing = [0.0 if p.amount and model.stage != Stage.CONVERTER else np.nan for p in model.parameters]
    theta = np.array([values.get(p.name, default) for p, default in zip(model.parameters, missing, strict=True)])
    return (model, theta) if np.isfinite(theta).all() else None


def _scene(truth: ConcealedTruth, sim: Recording) -> Scene:
    """Scene of a case, its motion through the simulation's poses."""
    poses = sim.truth
    ready = smoother(poses)
    t_s = seconds(poses.t_ns, int(poses.t_ns[0]))
    position, quaternion = (make_interp_spline(t_s, y, k=DEGREE) for y in (poses.p_wb, ready.q_wb_wxyz))
    duration = (len(sim.imu) - 1) / RATE_HZ
    first = next(iter(sim.scalars.values()))
    return Scene(
        ready,
        Motion(position, quaternion, 0.0, float(t_s[-1])),
        0.0,
        duration,
        np.array(truth.noise_std["real"]),
        seconds(first.t_ns, int(first.t_ns[0])),
        {topic: scalars.values[:, 0] for topic, scalars in sim.scalars.items()},
    )


def reported_gain(truth: ConcealedTruth, found: Findings, findings: Sequence[ReportedFinding]) -> float | None:
    """Reported share of the achievable reduction of the residual's power.

    Signals weighted by their misfit over the noise. Achievable is a reduction down to the recording's own noise: that of the
    simulation can be smoothed away.
    """
    shares, weights = [], []
    for k, signal in enumerate(SIGNALS):
        best: Rms = truth.achievable[signal]
        weight = (best.rms_before / best.rms_after) ** 2 - 1.0
        if weight > MIN_MISFIT:
            weights.append(weight)
            noise = truth.noise_std["real"][3 * k :][:3]
            shares.append(_reported_share(signal, float(np.sqrt(np.mean(np.square(noise)))), found, findings))
    return float(np.average(shares, weights=weights)) if shares else None


def _reported_share(signal: str, noise: float, found: Findings, findings: Sequence[ReportedFinding]) -> float:
    reported = [found.closer[signal]] if signal in found.closer else []
    reported = reported or [finding.held_out for finding in findings if finding.signal in (signal, *BOTH)]
    pairs = [(rms.rms_before, rms.rms_after) for rms in reported if rms.rms_before is not None and rms.rms_after is not None]
    if not pairs:
        return 0.0
    before, after = max(before for before, _ in pairs), min(after for _, after in pairs)
    floor = found.unexplained.noise_floor.get(signal) or noise
    floor = noise * (np.sqrt(3.0) if floor > noise * 3.0**0.25 else 1.0)  # of three axes together, or of one
    maximum = before**2 - floor**2
    return float(np.clip((before**2 - after**2) / maximum, 0.0, 1.0)) if maximum > 0.0 else 0.0
