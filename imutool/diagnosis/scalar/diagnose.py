"""Where a signal of any kind and its simulation differ, and what was left out: the IMU's diagnosis for one number of a log.

fields ─ beside ─> one clock ─ noise ─> Weighed ─ Search ─> Found ─> SignalDiagnosis, in the words of `diagnosis`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy.interpolate import BSpline

from imutool.diagnosis.estimation.timestamps import LEAST_DIGITS, grid
from imutool.diagnosis.localization import regime
from imutool.diagnosis.result import Curve as ToldCurve
from imutool.diagnosis.result import Estimate, Finding, HeldOut, Kind, Located, SignalTraces, Unexplained
from imutool.diagnosis.scalar import effects, fit
from imutool.diagnosis.scalar.alignment import Beside, beside
from imutool.diagnosis.scalar.effects import Chosen, Column, Curve, Samples
from imutool.diagnosis.scalar.fit import Fit, WhitenedLog
from imutool.diagnosis.scalar.search import Found, Judged, Search
from imutool.mcap_io.fields import Fields

BETTER_NOISE = 0.95  # of what the noise was first taken for, below which effects are asked once more
WINDOW_S, CLEAR, JOIN_S = 1.0, 12.0, 1.5  # as `locate` has it for the IMU
SHOWN_KNOTS = 41
WHITE = 1.15
EXACT = 1e-3
SAME_GRID = 0.01
_KINDS: Mapping[str, Kind] = {"driven": "driven", "unknown": "unknown"}
RIDGE = 1e-8
RICH_KNOTS = 12


@dataclass(frozen=True, eq=False)
class SignalDiagnosis:
    """The answer for one signal, in parts that a `Diagnosis` takes; findings come strongest first."""

    signal: str
    unit: str
    located: tuple[Located, ...]
    findings: tuple[Finding, ...]
    offset: Estimate
    not_identifiable: tuple[str, ...]
    unexplained: Unexplained
    closer: HeldOut
    remarks: tuple[str, ...]
    traces: SignalTraces


def diagnose_signal(real: Fields, sim: Fields, others: Mapping[str, Fields], name: str) -> SignalDiagnosis:
    """What separates a recorded signal from its simulation, but for a constant and noise.

    `others` are further numbers of the recording, on its clock, which may drive the misfit; `name` is TOPIC.field, as findings
    have it.

    Raises:
        DataError: constant, too short, or not of one motion; the message says what to do.
    """
    pair = beside(real, sim, others, name)
    unit = real.unit or sim.unit
    lsb = _lsb(real, sim)
    always: Chosen = ((effects.offset(float(np.ptp(pair.real)), unit), np.zeros(1)),)
    if pair.aligned_s is not None:
        always = ((effects.delay(0.0, effects.step_s(pair.ideal)), np.zeros(1)), *always)
    candidates = [
        one for one in effects.named(pair.ideal, pair.real, pair.lag_s, unit) if one.name != "delay" or pair.aligned_s is None
    ]
    later = [list(effects.driven(pair.ideal, pair.real, unit)), list(effects.unknown(pair.ideal, unit))]
    signal = _weighed(pair, pair.real - _rich(pair), lsb)
    found = Search(signal, always, candidates, later).run()
    again = _weighed(pair, pair.real - pair.ideal.expected(found.whole.chosen), lsb)
    if again.noise.level < BETTER_NOISE * signal.noise.level:  # the effects' own high frequencies were taken for noise
        signal = again
        found = Search(signal, always, candidates, later).run(found.whole.chosen[len(always) :])
    return _told(pair, signal, found, len(always), name, unit, lsb)


def _weighed(pair: Beside, residual: Samples, lsb: float) -> WhitenedLog:
    usable = pair.fitted | pair.held_out
    x = pair.ideal.taken(()).x
    rounding = None
    if lsb:  # an error of rounding is no white noise where the signal is slow
        model = pair.real - residual
        _, rounding = fit.density(np.rint(model / lsb) * lsb - model, usable, pair.rate_hz)
    noise = fit.noise(residual, usable, pair.rate_hz, fit.edge_hz(x, pair.rate_hz), pair.simulated, rounding)
    return WhitenedLog(pair.ideal, pair.real, pair.fitted, pair.held_out, noise)


def _rich(pair: Beside) -> Samples:
    """The recording as far as anything smooth in signal, derivatives and time follows it: what it leaves is noise, or sharp."""
    usable = pair.fitted | pair.held_out
    centred = pair.ideal.t_s - pair.lag_s
    at = (centred - pair.ideal.start_s) * pair.ideal.rate_hz
    fine = pair.ideal.fine
    k = np.arange(len(fine))
    derivatives = [fine]
    for _ in range(3):
        derivatives.append(np.gradient(derivatives[-1]) * pair.ideal.rate_hz)
    columns = [np.interp(at, k, column) for column in derivatives]
    x, dx = columns[0], columns[1]
    columns += [np.sign(x), np.sign(dx), *_splines(x).T, *_splines(dx).T, *_splines(pair.ideal.t_s).T]
    A = np.stack(columns, axis=1)
    size = np.linalg.norm(A[usable], axis=0)
    A = A[:, size > 0] / size[size > 0]
    N = A[usable].T @ A[usable] + RIDGE * np.eye(A.shape[1])
    return np.asarray(A @ np.linalg.solve(N, A[usable].T @ pair.real[usable]))


def _splines(x: Samples) -> Float64[np.ndarray, "n q"]:
    first, last = float(x.min()), float(x.max())
    knots = np.concatenate([[first] * 3, np.linspace(first, last, RICH_KNOTS - 2), [last] * 3])
    return np.asarray(BSpline.design_matrix(np.clip(x, first, last), knots, 3).toarray()[:, :RICH_KNOTS])


def _lsb(real: Fields, sim: Fields) -> float:
    """The step that recorded values are multiples of, 0 where they are of none or the simulation's are of the same."""
    step, there = grid(real.values), grid(sim.values)
    return 0.0 if there and abs(step / there - 1.0) < SAME_GRID else step


# ── what is told ──


def _told(pair: Beside, signal: WhitenedLog, found: Found, always: int, name: str, unit: str, lsb: float) -> SignalDiagnosis:
    level = signal.noise.level
    chosen, held = found.whole.chosen, pair.held_out
    before, after = pair.ideal.expected(()), pair.ideal.expected(chosen)
    before = before + (pair.real - before)[pair.fitted | held].mean()
    findings = [_finding(pair, found, one, always + k, always, level, name, unit) for k, one in enumerate(found.judged)]
    rounded = lsb > LEAST_DIGITS * level
    if rounded:
        digits = _rounded(pair, after, lsb, name, unit)
        findings.append(digits)
        phase = float(np.median(np.mod(pair.real + 0.5 * lsb, lsb))) - 0.5 * lsb
        after = (
            np.rint((after - phase) / lsb) * lsb + phase if digits.held_out.rms_after < digits.held_out.rms_before else after
        )
    p_value = min((one.p_value for one in found.judged), default=1.0)
    places = _located(pair, after - before, level, name, unit, p_value) if found.judged else ()
    place = next(k for k in range(always) if chosen[k][0].name == "offset")
    rms = _rms(pair.real - after, held)
    floor = float(np.hypot(level, lsb / np.sqrt(12.0))) if rounded else level
    return SignalDiagnosis(
        signal=name,
        unit=unit,
        located=places,
        findings=tuple(findings),
        offset=Estimate(float(chosen[place][1][0]), float(found.whole.std(place)[0]), unit),
        not_identifiable=tuple(f"{name}.delay" for _ in range(int(pair.aligned_s is not None))),
        unexplained=Unexplained(rms, level, rms < WHITE * floor),
        closer=_held_out(pair, before, after, unit),
        remarks=_remarks(pair, name),
        traces=SignalTraces(pair.ideal.t_s, pair.real, before, after, held, unit),
    )


def _remarks(pair: Beside, name: str) -> tuple[str, ...]:
    if pair.aligned_s is None:
        return ()
    return (
        f"{name}: the two clocks share no epoch; aligned by the signal ({pair.aligned_s:+.3f} s), so that a delay between them "
        "cannot be seen",
    )


def _rms(residual: Samples, rows: Bool[np.ndarray, " n"]) -> float:
    return float(np.sqrt(np.mean(residual[rows] ** 2)))


def _held_out(pair: Beside, before: Samples, after: Samples, unit: str) -> HeldOut:
    rms = [_rms(pair.real - there, pair.held_out) for there in (before, after)]
    return HeldOut(rms[0], rms[1], unit, round(float(pair.held_out.sum()) / pair.rate_hz, 1))


def _finding(pair: Beside, found: Found, one: Judged, k: int, always: int, level: float, name: str, unit: str) -> Finding:
    """One effect: what leaving it out costs on time that its parameters were not fitted to."""
    fitted = found.fitted
    without = (*fitted.chosen[:k], *fitted.chosen[k + 1 :])
    with_, alone, nothing = (pair.ideal.expected(these) for these in (fitted.chosen, without, fitted.chosen[:always]))
    usable = pair.fitted
    alone, nothing = (there + (pair.real - there)[usable].mean() for there in (alone, nothing))
    held, all_ = _held_out(pair, alone, with_, unit), _held_out(pair, nothing, with_, unit)
    misfit = max(all_.rms_before**2 - level**2, 1e-300)
    return Finding(
        effect=one.effect.name,
        signal=name,
        share=float(np.clip((held.rms_before**2 - held.rms_after**2) / misfit, 0.0, 1.0)),
        p_value=one.p_value,
        false_discovery_rate=one.false_discovery_rate,
        parameters=_parameters(found.whole, k),
        equation=one.effect.equation,
        held_out=held,
        driver=one.effect.driver,
        similar=one.similar,
        curve=_curve(found.whole, k, unit),
        kind=_KINDS.get(one.effect.name, "catalogue"),
        variable=one.effect.forward.variable if isinstance(one.effect.forward, Curve) else one.effect.driver,
    )


def _parameters(whole: Fit, k: int) -> dict[str, Estimate]:
    """As they were fitted; a curve is told by its values instead."""
    effect, theta = whole.chosen[k]
    if isinstance(effect.forward, Curve):
        return {}
    return {
        number.name: Estimate(float(value), float(std), number.unit)
        for number, value, std in zip(effect.numbers, theta, whole.std(k), strict=True)
    }


def _curve(whole: Fit, k: int, unit: str) -> ToldCurve | None:
    """A curve without a name by its values, with what they are sure to; its mean belongs to the offset."""
    forward, theta = whole.chosen[k][0].forward, whole.chosen[k][1]
    if not isinstance(forward, Curve):
        return None
    x = np.linspace(forward.first, forward.last, SHOWN_KNOTS)
    basis = forward.basis(x)
    centred = basis - basis.mean(axis=0)
    covariance = whole.covariance[whole.place(k), whole.place(k)]
    band = np.sqrt(np.einsum("nq,qp,np->n", centred, covariance, centred))
    return ToldCurve.of_arrays(forward.variable, forward.unit, x, (centred @ theta)[:, None], band[:, None])


def _rounded(pair: Beside, model: Samples, lsb: float, name: str, unit: str) -> Finding:
    """Values on a grid, which they show exactly; that the same noise put all of them there by chance is out of the question."""
    phase = float(np.median(np.mod(pair.real + 0.5 * lsb, lsb))) - 0.5 * lsb
    held = _held_out(pair, model, np.rint((model - phase) / lsb) * lsb + phase, unit)
    share = float(np.clip(1.0 - (held.rms_after / max(held.rms_before, 1e-300)) ** 2, 0.0, 1.0))
    parameters = {"lsb": Estimate(lsb, EXACT * lsb, unit)}
    return Finding("quantization", name, share, 0.0, 0.0, parameters, "y = lsb round(x / lsb)", held)


def _located(pair: Beside, misfit: Samples, level: float, name: str, unit: str, p_value: float) -> tuple[Located, ...]:
    """Seconds in which what the findings add stands out of the noise, and in which regime they are."""
    t_s = pair.ideal.t_s
    window = np.floor((t_s - t_s[0]) / WINDOW_S).astype(int)
    power = np.bincount(window, weights=((misfit - np.median(misfit)) / level) ** 2)
    inside = power > CLEAR
    if not inside.any():
        return ()
    taken = pair.ideal.taken(())
    variables: dict[str, tuple[str, Column]] = {
        "its value": (unit, taken.x),
        "its size": (unit, np.abs(taken.x - np.median(taken.x))),
        "its rate of change": (f"{unit}/s", np.abs(taken.dx)),
        "time": ("s", t_s),
    }
    for other, (at, values) in pair.ideal.channels.items():
        variables[other] = "", np.interp(t_s, at, values)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], inside.astype(int), [0]])))
    spans = [(float(t_s[0]) + first * WINDOW_S, float(t_s[0]) + last * WINDOW_S) for first, last in edges.reshape(-1, 2)]
    where = regime(inside, power, window, variables)
    return (Located(name, (), tuple(_joined(spans)), where, float(power[inside].sum() / power.sum()), p_value),)


def _joined(spans: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Those close to one another as one."""
    out: list[tuple[float, float]] = []
    for begin, end in spans:
        if out and begin - out[-1][1] < JOIN_S - WINDOW_S:
            out[-1] = out[-1][0], end
        else:
            out.append((begin, end))
    return out
