"""Comparison with a simulation of another motion: one description, fitted to both logs.

That one log shows an effect and the other does not is no difference between the two: it may move too little, or one cause may
go by another name there (a filter is a delay of slow motion). So the effects of the recording are fitted to the simulation,
too, and what is compared is numbers with their deviations (Gelman and Stern, The American Statistician 60, 2006).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from imutool.array_types import Float64
from imutool.diagnosis.compare_findings import ALIKE_SHARE
from imutool.diagnosis.estimation.aligned_log import Pair
from imutool.diagnosis.estimation.gauss_newton import Fit, fit
from imutool.diagnosis.estimation.jacobians import expected
from imutool.diagnosis.estimation.observability import exclude_each_other
from imutool.diagnosis.estimation.significance import scatter
from imutool.diagnosis.estimation.trial.model_error import FOLLOWING
from imutool.diagnosis.estimation.trial.selection import SelectedEffect, Selection, without
from imutool.diagnosis.estimation.whitening import WhitenedLog
from imutool.diagnosis.held_out import noise_floor
from imutool.diagnosis.result import Finding
from imutool.diagnosis.summarize import finding_of
from imutool.sensor.effect import Effect, Stage, Theta
from imutool.sensor.effects import vibration


def compared(found: Selection, sim: Selection, of_sim: Sequence[Finding]) -> tuple[Selection, tuple[Finding, ...], str]:
    """Selection, findings of the simulation, and a remark; both logs in the same words."""
    below = [within_model_error(e) for e in (found, sim)]
    clear = [[e for e in each.selected if e not in small] for each, small in zip((found, sim), below, strict=True)]
    both = [
        [e for e in small if not any(_is_rival(e.effect, other.effect) for other in others)]
        for small, others in zip(below, clear[::-1], strict=True)
    ]
    found, sim = (without(e, {small.effect.key for small in each}) for e, each in zip((found, sim), both, strict=True))
    left_out = {(e.effect.name, e.effect.equation) for e in both[1]}
    found = with_common_description(found, sim)
    known = with_twins([e for e in of_sim if (e.effect, e.equation) not in left_out], sim, found)
    names = ", ".join(dict.fromkeys(e.effect.name.replace("_", " ") for e in both[0]))
    return found, known, f"{names}: less than poses know of a motion, so not among the findings" if names else ""


def within_model_error(found: Selection) -> list[SelectedEffect]:
    """Selected effects that are smaller than the model error of a curve through poses.

    The motion is the largest effect of all, and its model errs by a share of it (`model_error`, 0.3 % of its size). A sensor
    with less noise shows such an error as scale, arm or curve, with certainty. Drifts and lines do not follow the motion.
    """
    logs, allowed = found.whole.logs, found.whole.logs[0].pair.settings.search.model_error
    squares = np.sum([_motion_squares(log) for log in logs], axis=0)
    signals = logs[0].pair.signals
    return [
        e
        for e in found.selected
        if not e.effect.of_time
        and e.effect.name != vibration.EFFECT.name
        and e.gain < allowed * min(squares[signals[sensor]].sum() for sensor in e.effect.sensors)
    ]


def with_common_description(found: Selection, sim: Selection) -> Selection:
    """Selection with the simulation's filter or clock effects, where they fit as well.

    They may leave more by `ALIKE_SHARE` of the size, as numbers may that are alike.
    """
    own, other = (tuple(e for e in x.whole.chosen[x.always :] if e[0].name in FOLLOWING) for x in (found, sim))
    if not own or not other or {e.key for e, _ in own} == {e.key for e, _ in other}:
        return found
    if not all(_is_comparable(effect, found.whole.logs) for effect, _ in other):
        return found
    rest = tuple(entry for entry in found.whole.chosen if entry not in own)
    alone, trial = (fit(found.whole.logs, (*rest, *more), part="all") for more in ((), other))
    if trial.objective > found.whole.objective + ALIKE_SHARE**2 * (alone.objective - found.whole.objective):
        return found
    first = max((x for x in found.selected if x.effect.name in FOLLOWING), key=lambda x: x.gain)
    kept = [x for x in found.selected if x.effect.name not in FOLLOWING]
    theta, std = _numbers(trial)
    named = [replace(first, effect=e, theta=theta[e.key], std=std[e.key], unidentified=()) for e, _ in other]
    kept = [replace(x, theta=theta[x.effect.key], std=std[x.effect.key]) for x in kept]
    return replace(found, selected=(*named, *kept), fitted=fit(found.fitted.logs, trial.chosen), whole=trial)


def with_twins(known: Sequence[Finding], sim: Selection, real: Selection) -> tuple[Finding, ...]:
    """Findings of a simulation, with the recording's effects in place of their rivals."""
    chosen, always, logs = sim.whole.chosen, sim.always, sim.whole.logs
    keys = {effect.key for effect, _ in chosen}
    asked = [x for x in real.selected if _is_comparable(x.effect, logs)]
    if not any(x.effect.key not in keys for x in asked):
        return tuple(known)
    rivals = {e.key for e, _ in chosen[always:] if any(_is_rival(e, x.effect) for x in asked)}
    others = tuple(entry for entry in chosen if entry[0].key not in rivals)
    whole = fit(logs, (*others, *((x.effect, x.theta) for x in asked)), part="all")
    theta, std = _numbers(whole)
    new = tuple(SelectedEffect(x.effect, theta[x.effect.key], std[x.effect.key], (), 1.0, 1.0, 0.0) for x in asked)
    selection = Selection(new, fit(sim.fitted.logs, whole.chosen), whole, sim.tried, always)
    floor = noise_floor(logs)
    twins = [finding_of(logs, selection, x, floor) for x in new]
    replaced = {(e.name, e.equation) for e, _ in chosen if e.key in rivals}
    return (*(x for x in known if (x.effect, x.equation) not in replaced), *twins)


def _motion_squares(log: WhitenedLog) -> Float64[np.ndarray, " k"]:
    """Squares of the motion by column, white as its noise, but for a constant."""
    rows = log.rows("all")
    white, constant = log.whiten(expected(log.pair, ()))[rows], log.constants[rows]
    size = np.maximum((constant**2).sum(axis=0), np.finfo(np.float64).tiny)
    return np.asarray(((white - constant * ((constant * white).sum(axis=0) / size)) ** 2).sum(axis=0))


def _is_rival(effect: Effect, asked: Effect) -> bool:
    """Whether two effects are one word or two for the same thing."""
    return exclude_each_other(effect, asked) or (effect.name in FOLLOWING and asked.name in FOLLOWING)


def _is_comparable(effect: Effect, logs: Sequence[WhitenedLog]) -> bool:
    """Whether an effect has a meaning in other logs: no limit and no time of one log, and channels that all have."""
    channels = set.intersection(*(set(log.pair.channels) for log in logs if isinstance(log.pair, Pair)))
    needs = [need for need in effect.needs if need != "attitude"] + ([effect.variable] if effect.kind == "driven" else [])
    known = all(any(need in name for name in channels) for need in needs)
    return known and effect.stage != Stage.CONVERTER and not any(parameter.begins for parameter in effect.parameters)


def _numbers(found: Fit) -> tuple[dict[str, Theta], dict[str, Theta]]:
    """Parameters and robust deviations by effect."""
    std = scatter(found).std if found.chosen else {}
    return {e.key: theta for e, theta in found.chosen}, {key: np.asarray(value) for key, value in std.items()}
