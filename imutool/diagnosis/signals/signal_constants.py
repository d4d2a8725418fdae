"""Constants of a signal in every fit: its zero, its digits, torque constants of currents.

Where efforts are motor currents, each joint has a gain. Currents differ from torques by a large factor of their own at each
joint. Next to such a misfit all else is small, so that the factors have to be known before effects are searched for. A heavy
load makes efforts larger as well, and so does a controller that asks for what a limit keeps back; efforts that oscillate and
act late are unlike what a motion needs. All are compared.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from imutool.array_types import Float64
from imutool.diagnosis.estimation.gauss_newton import fit
from imutool.diagnosis.estimation.jacobians import Chosen
from imutool.diagnosis.estimation.significance import bic, scatter
from imutool.diagnosis.estimation.trial.selection import Selection
from imutool.diagnosis.estimation.whitening import WhitenedLog
from imutool.diagnosis.held_out import held_out_rms
from imutool.diagnosis.result import Estimate, Finding, HeldOut
from imutool.diagnosis.signals.aligned_signal import AlignedSignal
from imutool.diagnosis.signals.noise import LEARNT_ERROR, learnt_errors
from imutool.sensor.effect import Effect
from imutool.sensor.robot_effects.joint_dynamics import own_columns

FAR_GAIN = 2.0  # of an actuator: no motor loses or gains as much, so that its effort is in another unit
CERTAIN = 6.0  # deviations from which a constant is a finding
REWEIGHTED, SMALL_LEFT = 20, 0.01  # times that a regression is, and the least residual that it weighs by, over their mean
EXACT = 1e-3  # of an LSB, that its estimate may be off
GAIN, LOAD, LIMIT, DELAY = "actuator_gain", "payload", "torque_saturation", "actuator_delay"
Constants = Float64[np.ndarray, " k"]
CONSTANTS = {
    "magnetic": ("hard_iron", "field += hard iron"),
    "range": ("offset", "y += offset"),
    "positions": ("encoder_offset", "the angle read = angle + offset"),
}
"""Name and equation of a constant, where it is physics and no news of a sensor's zero."""


# ── torque constants ──


def torque_constants(log: WhitenedLog, candidates: Sequence[Effect], always: Chosen) -> Constants | None:
    """Torque (N m) of a unit of each recorded effort; None where they are torques."""
    signal: AlignedSignal = log.pair  # type: ignore[assignment]  # it was made of one
    gains = [effect for effect in candidates if effect.name == GAIN]
    if not gains or not _far(first := _at_first_sight(signal)):
        return None
    currents = (*always, *((effect, np.array([gain])) for effect, gain in zip(gains, first.values(), strict=True)))
    torques, limited = (*always, *((effect, np.ones(1)) for effect in gains)), fit([log], always)
    far = _far(first).keys()
    for limit in (effect for effect in candidates if effect.name == LIMIT and far & {*(effect.sensors or signal.names)}):
        limited = min((fit([log], (*limited.chosen, (limit, start))) for start in signal.starts(limit)), key=bic)
    loads = [(load, start) for load in candidates if load.name == LOAD for start in signal.starts(load)]
    is_single = signal.columns == 1  # whose load is a gain and a rotor
    beside = (limited.chosen,) if is_single else (currents, torques, limited.chosen)
    late = [(delay, start) for delay in candidates if delay.name == DELAY for start in signal.starts(delay)]
    trials = [fit([log], currents), limited, *(fit([log], (*base, load)) for base in beside for load in loads)]
    trials += [fit([log], (*base, chosen)) for base in (currents, torques) for chosen in late]
    best = {effect.key: float(theta[0]) for effect, theta in min(trials, key=bic).chosen}
    constants = {name: best.get(effect.key, 1.0) for name, effect in zip(first, gains, strict=True)}
    return np.array(list(constants.values())) if _far(constants) else None


def current_remark(gains: Mapping[str, float]) -> list[str]:
    """Remark on efforts that are motor currents (A) in one log; `gains` by joint."""
    if not (far := _far(gains)):
        return []
    each = ", ".join(f"{name}: {gain:.4g}" for name, gain in sorted(far.items()))
    return [f"The simulated efforts are a multiple of the recorded ones, as if those were motor currents (N m/A): {each}"]


def as_torques(signal: AlignedSignal, constants: Constants) -> AlignedSignal:
    """The signal with its recorded efforts, which are also its commands, as torques."""
    channels = dict(signal.ideal.channels)
    for name, constant in zip(signal.names, constants.tolist(), strict=True):
        t_s, values = channels[name]
        channels[name] = t_s, constant * values
    ideal = replace(signal.ideal, channels=channels)
    so_far = constants * np.array(signal.constants or 1.0)
    return replace(signal, real=constants * signal.real, ideal=ideal, constants=tuple(so_far.tolist()))


def torque_findings(
    log: WhitenedLog, selection: Selection, after: Float64[np.ndarray, "n k"], level: Float64[np.ndarray, " k"]
) -> Iterator[Finding]:
    """Gain of each joint whose efforts were converted, but for those that are 1."""
    signal: AlignedSignal = log.pair  # type: ignore[assignment]  # it was made of one
    if not signal.constants:
        return
    stds = scatter(selection.whole).std
    errors = learnt_errors(log, selection.whole)
    gains = [(effect, float(theta[0])) for effect, theta in selection.whole.chosen if effect.name == GAIN]
    before = after + signal.real - signal.real / np.array(signal.constants)  # what leaves the log's numbers, taken as torques
    for k, ((effect, factor), constant) in enumerate(zip(gains, signal.constants, strict=True)):
        gain, name = constant * factor, signal.names[k]
        std = float(np.linalg.norm([constant * stds[effect.key][0], constant * errors[effect.key][0], LEARNT_ERROR * gain]))
        if abs(gain - 1.0) > CERTAIN * std:
            held_out = held_out_rms([log], [before], [after], name)
            share = 1.0 - (held_out.rms_after**2 - level[k] ** 2) / max(held_out.rms_before**2 - level[k] ** 2, 1e-300)
            numbers = {"gain": Estimate(gain, std, effect.parameters[0].unit)}
            yield Finding(GAIN, name, float(np.clip(share, 0.0, 1.0)), 0.0, 0.0, numbers, effect.equation, held_out)


def _far(gains: Mapping[str, float]) -> dict[str, float]:
    """Gains that no actuator has."""
    return {name: gain for name, gain in gains.items() if not 1.0 / FAR_GAIN < gain < FAR_GAIN}


def _at_first_sight(signal: AlignedSignal) -> dict[str, float]:
    """Gains by regression of recorded efforts on expected ones, with friction, a rotor and a constant of each joint.

    By least absolute deviations: a unit is that of all samples, while commands beyond a limit are of some alone.
    """
    rows, sampled, out = signal.usable[:, 0], signal.sampled, dict[str, float]()
    own = own_columns(sampled.state, signal.columns)[rows]
    for k, (name, needed, efforts) in enumerate(zip(signal.names, sampled.x[rows].T, signal.real[rows].T, strict=True)):
        columns = np.column_stack([needed, own[:, k, 4 * k : 4 * k + 4]])
        columns, length = columns / np.linalg.norm(columns, axis=0), float(np.linalg.norm(needed))
        weight = np.ones(len(efforts))
        for _ in range(REWEIGHTED):
            shares = np.linalg.lstsq(columns * weight[:, None], efforts * weight, rcond=None)[0]
            residual = np.abs(efforts - columns @ shares)
            weight = 1.0 / np.sqrt(np.maximum(residual, SMALL_LEFT * float(residual.mean()) + 1e-300))
        out[name] = length / float(shares[0]) if shares[0] else 1.0
    return out


def gains_of(selection: Selection) -> Constants:
    """Gains of all joints as fitted."""
    return np.array([float(theta[0]) for effect, theta in selection.whole.chosen if effect.name == GAIN])


# ── zeros and digits ──


def offsets_of(pair: AlignedSignal, selection: Selection) -> Iterator[tuple[str, Estimate]]:
    """Constant of each column, by its name."""
    stds = selection.whole.stds()
    for effect, theta in selection.whole.chosen:
        if effect.name == "offset":
            k = pair.names.index(effect.sensors[0]) if effect.sensors else 0
            yield pair.names[k], Estimate(float(theta[0]), float(stds[effect.key][0]), pair.units[k])


def constant_findings(
    pair: AlignedSignal, offsets: Mapping[str, Estimate], level: Float64[np.ndarray, " k"]
) -> Iterator[Finding]:
    """Finding of a constant where it is physics: hard iron, an encoder's zero, a range's offset."""
    name, equation = CONSTANTS.get(pair.kind, ("", ""))
    values, stds = (np.array([getattr(estimate, part) for estimate in offsets.values()]) for part in ("value", "std"))
    if not name or not (np.abs(values) > CERTAIN * stds).any():
        return
    labels = [column.rpartition(".")[2] for column in pair.names] if pair.columns > 1 else [name.rpartition("_")[2]]
    parameters = dict(zip(labels, offsets.values(), strict=True))
    noise, size = float(np.sqrt((level**2).sum())), float(np.linalg.norm(values))
    gain = HeldOut(float(np.hypot(size, noise)), noise, pair.units[0], 0.0)
    yield Finding(name, pair.name, 1.0, 0.0, 0.0, parameters, equation, gain)


def digits(
    log: WhitenedLog, after: Float64[np.ndarray, "n k"], k: int, lsb: float
) -> tuple[Finding, Float64[np.ndarray, "n k"]]:
    """Finding of the digits, which no noise makes by chance, and the rounded expectation."""
    name, real = list(log.pair.signals)[k], log.pair.real[:, k]
    phase = float(np.median(np.mod(real + 0.5 * lsb, lsb))) - 0.5 * lsb
    rounded = after.copy()
    rounded[:, k] = np.rint((after[:, k] - phase) / lsb) * lsb + phase
    gain = held_out_rms([log], [after], [rounded], name)
    share = float(np.clip(1.0 - (gain.rms_after / max(gain.rms_before, 1e-300)) ** 2, 0.0, 1.0))
    parameters = {"lsb": Estimate(lsb, EXACT * lsb, log.pair.unit_of(name))}
    return Finding("quantization", name, share, 0.0, 0.0, parameters, "y = lsb round(x / lsb)", gain), rounded
